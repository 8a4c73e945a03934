"""`zero-shot` and `multi-view`: the paper's Tables II and III, row by row, then the documents."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from carstudio import __version__
from carstudio.comparison.budgets import Budget, within
from carstudio.comparison.document import Document, comparison_tables, write_document
from carstudio.comparison.grid import qualitative_grid
from carstudio.comparison.rows import Row
from carstudio.comparison.running import Finished, Work, finish_row
from carstudio.evaluation.results import write_rows
from carstudio.evaluation.tables import Table

TITLES = {
    "zero-shot": "Single-view supervision, cars never seen (the paper's Table II)",
    "multi-view": "Single-view against multi-view supervision (the paper's Table III)",
    "scaling": "More training cars, recolouring, and smaller images",
    "ttopt": "Test-time optimisation (the paper's learning curve)",
}


def make_table(name: str, work: Work, rows: Sequence[Row], budget: Budget) -> list[Table]:
    """Finish every row, write `NAME.md`, `.tex`, `.html`, `NAME.png` and `rows.jsonl`; returns the tables."""
    finished = []
    for done, row in enumerate(rows):
        work.report(name, done, len(rows), row.name)
        finished.append(finish_row(work, replace(row, config=within(budget, row.config))))
    work.report(name, len(rows), len(rows), "")
    tables = comparison_tables(finished, title=TITLES[name])
    grid = qualitative_grid(work, rows)
    caption = "Input photo, each model's colour and opacity (Turbo: dark blue 0, dark red 1), truth."
    pictures = () if grid is None else ((f"{name}.png", caption, grid),)
    document = Document(name, TITLES[name], facts(work, finished, budget), tuple(tables), pictures)
    write_rows(
        work.out / "rows.jsonl",
        [score for done in finished for score in done.scores],
        replace(finished[0].header, command=work.command),
    )
    write_document(document, work.out)
    return tables


def facts(work: Work, finished: Sequence[Finished], budget: Budget) -> tuple[tuple[str, str], ...]:
    """What holds for all rows: budget, size, data, split, seed, cost, command."""
    return facts_of(work, [(done.row, done.summary) for done in finished], budget)


def facts_of(work: Work, trained: Sequence[tuple[Row, dict[str, Any]]], budget: Budget) -> tuple[tuple[str, str], ...]:
    """`facts` of rows and their trainings' summaries."""
    parts = {part: work.store.patch_ids(split=work.split, part=part) for part in ("train", "test")}
    spent = sum(float(summary["cpu_seconds"]) for _, summary in trained)
    by_row = "; ".join(f"{row.name} {summary['steps']:,} / {summary['cpu_seconds']:,.0f}" for row, summary in trained)
    own = [row.name for row, _ in trained if "sampling" not in {field.name for field in fields(row.config.model)}]
    unlike = (("not alike", f"{', '.join(own)}: own encoder, batch, loss and schedule; equal in budget only"),)
    return (
        ("budget", str(budget)),
        ("data", f"{work.store.path.name}, sha256 {work.store.data_sha256[:16]}"),
        ("split", f"{work.split}: {len(parts['train']):,} photos train, {len(parts['test']):,} are held out"),
        ("scored", "all held-out photos" if work.limit is None else f"at most {work.limit} photos per protocol"),
        ("seed", str(work.seed)),
        ("cost", f"{spent:,.0f} CPU-seconds of training in all (steps / CPU-seconds: {by_row})"),
        *(unlike if own else ()),
        ("made by", f"carstudio {__version__}: {work.command}"),
    )
