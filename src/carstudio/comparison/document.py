"""A comparison written out three times from the same data: Markdown, LaTeX, one HTML page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from carstudio.comparison.paper_figures import PaperFigures
from carstudio.comparison.running import Finished
from carstudio.evaluation.results import ResultRow
from carstudio.evaluation.summary import summarise
from carstudio.evaluation.tables import Cell, Mark, Table, result_tables, to_latex, to_markdown
from carstudio.files import write_text
from carstudio.images import encode_png, write_png
from carstudio.report.page import Page, Picture, Section, Text, write_page
from carstudio.report.sheets import Pixels

PAPER_NOTE = (
    "The paper's columns are its own figures, of its own data and after 500,000 steps x 3,072 rays, best and second "
    "best marked among them: they stand beside ours for the order of the rows, not for the numbers."
)


@dataclass(frozen=True)
class Document:
    """What a table's files say: title, facts that hold for all rows (name, value), tables, pictures with captions."""

    name: str
    title: str
    facts: tuple[tuple[str, str], ...]
    tables: tuple[Table, ...]
    pictures: tuple[tuple[str, str, Pixels], ...] = ()  # file name, caption, pixels


def comparison_tables(finished: Sequence[Finished], *, title: str) -> list[Table]:
    """One table per protocol: our scores with intervals, what each row cost, and the paper's own figures."""
    by_name = {done.row.name: done for done in finished}
    scores: list[ResultRow] = [score for done in finished for score in done.scores]
    tables = []
    groups: dict[tuple[str, str], list[str]] = {}
    summaries = summarise(scores)
    for summary in summaries:
        groups.setdefault((summary.protocol, summary.split), []).append(summary.method)
    for (protocol, split), names in groups.items():
        chosen = [s for s in summaries if (s.protocol, s.split) == (protocol, split)]
        rows = [by_name[name] for name in names]
        titled = [replace(summary, method=done.row.title) for summary, done in zip(chosen, rows, strict=True)]
        (table,) = result_tables(titled, intervals=True)
        table = replace(table, caption=f"{title}: protocol {protocol}, split {split}")
        tables.append(
            with_columns(with_columns(table, *cost_columns(rows)), *paper_columns([d.row.paper for d in rows]))
        )
    return tables


def with_columns(table: Table, heads: Sequence[str], columns: Sequence[Sequence[Cell]], note: str = "") -> Table:
    """The table with further columns at its right and a further note."""
    rows = tuple((*row, *(column[i] for column in columns)) for i, row in enumerate(table.rows))
    notes = (*table.notes, note) if note else table.notes
    return replace(table, columns=(*table.columns, *heads), rows=rows, notes=notes)


def cost_columns(finished: Sequence[Finished]) -> tuple[list[str], list[list[Cell]]]:
    """Parameters, training steps and CPU-seconds of each row."""
    return ["Parameters (M)", "Steps", "CPU-s"], [
        [Cell(f"{done.num_parameters / 1e6:.2f}") for done in finished],
        [Cell(f"{done.summary['steps']:,}") for done in finished],
        [Cell(f"{done.summary['cpu_seconds']:,.0f}") for done in finished],
    ]


def paper_columns(figures: Sequence[PaperFigures | None]) -> tuple[list[str], list[list[Cell]], str]:
    """The paper's three figures with their marks; no columns where no row is the paper's."""
    if not any(figures):
        return [], [], ""
    columns = []
    for name, digits, larger_is_better in (("psnr", 2, True), ("ssim", 4, True), ("lpips", 4, False)):
        values = [None if one is None else float(getattr(one, name)) for one in figures]
        ranked = sorted({value for value in values if value is not None}, reverse=larger_is_better)
        columns.append(
            [Cell("–") if value is None else Cell(f"{value:.{digits}f}", _mark(ranked, value)) for value in values]
        )
    return ["paper PSNR ↑", "paper SSIM ↑", "paper LPIPS ↓"], columns, PAPER_NOTE


def _mark(ranked: Sequence[float], value: float) -> Mark:
    rank = ranked.index(value)
    return "" if rank > 1 or len(ranked) < 2 else "best" if rank == 0 else "second"


def write_document(document: Document, out: Path) -> list[Path]:
    """`NAME.md`, `NAME.tex` and `NAME.html` (pictures embedded; PNG files lie beside them)."""
    paths = [out / f"{document.name}.{ending}" for ending in ("md", "tex", "html")]
    for file, _, pixels in document.pictures:
        write_png(out / file, pixels)
    write_text(paths[0], _markdown(document))
    write_text(paths[1], _latex(document))
    pictures = [Picture(source=encode_png(pixels), caption=caption) for _, caption, pixels in document.pictures]
    sections = [Section(title="Scores", blocks=list(document.tables))]
    if pictures:
        sections.append(Section(title="Pictures", blocks=pictures))
    facts = "\n\n".join(f"{name}: {value}" for name, value in document.facts)
    sections.append(Section(title="How it was made", blocks=[Text(facts)]))
    write_page(paths[2], Page(title=document.title, sections=sections))
    return paths


def _markdown(document: Document) -> str:
    facts = "\n".join(f"- {name}: {value}" for name, value in document.facts)
    tables = "\n".join(to_markdown(table) for table in document.tables)
    pictures = "".join(f"\n![{caption}]({file})\n" for file, caption, _ in document.pictures)
    return f"# {document.title}\n\n{facts}\n\n{tables}{pictures}"


def _latex(document: Document) -> str:
    facts = "\n".join(f"% {name}: {' '.join(value.split())}" for name, value in document.facts)
    return f"% {document.title}\n{facts}\n\n" + "\n".join(to_latex(table) for table in document.tables)
