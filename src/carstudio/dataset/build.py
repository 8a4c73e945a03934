"""`carstudio build`: a source of photographs in, a CarPatch3D store out.

Frames are worked on in processes and written in order, so that the number of workers changes no byte. An interrupted
build goes on where it stopped when it is started again with the same settings.
"""

import time
from contextlib import closing
from dataclasses import asdict, replace

from carstudio.dataset.duplicates import find_duplicates
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.inputs import digest_of_inputs
from carstudio.dataset.judging import judge_store
from carstudio.dataset.plans import BuildConfig, SourceKind, input_places, plan_frames, plan_legacy
from carstudio.dataset.runs import is_made_already, write_run
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PARTS, PatchStore, StoreWriter, open_store
from carstudio.dataset.summary import BuildSummary
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.locks import clear_leftovers
from carstudio.progress import Report, silent

__all__ = ["BuildConfig", "BuildSummary", "SourceKind", "build"]


def build(config: BuildConfig, report: Report = silent) -> BuildSummary:
    """Make the store `config.out`; verdicts and splits are written at the end."""
    start = time.perf_counter()
    settings = asdict(config) | {"inputs": digest_of_inputs(input_places(config))}
    if is_made_already(config.out, settings):
        clear_leftovers(config.out)
        return summarize(open_store(config.out), source=config.source)
    plan = plan_legacy(config, report) if config.source == "legacy-json" else plan_frames(config, settings["inputs"])
    workers = _num_workers(config.workers, plan.num_items // (2 * plan.chunk), plan.workers)
    problems = list(plan.problems)
    with StoreWriter(config.out, source=plan.source, resume_key=plan.resume_key) as writer:
        write_run(config.out, settings)
        work, items = plan.start(writer.ids())
        with closing(ordered_map(work, items, workers=workers, chunk=plan.chunk)) as results:
            done = 0
            for result in results:
                for record in result.records:
                    writer.append(record)
                problems += result.problems
                done += result.num_items
                report("build", done, plan.num_items, f"{len(writer)} candidates")
        judge_and_split(writer, plan.filters, finds_duplicates=plan.finds_duplicates, workers=workers, report=report)
    summary = summarize(open_store(config.out), source=plan.source)
    return replace(summary, problems=tuple(problems), seconds=time.perf_counter() - start)


def judge_and_split(
    writer: StoreWriter,
    recipe: FilterRecipe,
    *,
    finds_duplicates: bool = False,
    workers: int = 1,
    report: Report = silent,
) -> None:
    """Verdicts and splits of all that was written: before the writer closes, so that "finished" comes last.

    A run killed before that is unfinished and goes on when it is started again.
    """
    writer.flush()
    store = open_store(writer.path, lock=writer.lock)
    if finds_duplicates:
        find_duplicates(store, workers=min(workers, 1 + len(store) // 2000), report=report)
    judge_store(store, recipe)
    write_splits(store)


def summarize(store: PatchStore, *, source: str) -> BuildSummary:
    """Count everything in a finished store."""
    info = store.info()
    return BuildSummary(
        out=store.path,
        source=source,
        candidates=len(store),
        kept=info["kept"],
        instances=info["kept_instances"],
        reasons=info["reasons"],
        splits={name: {part: parts.get(part, 0) for part in PARTS} for name, parts in info["splits"].items()},
    )


def _num_workers(workers: int, most: int, most_useful: int) -> int:
    if workers < 0:
        raise InputError(f"--workers must be 0 (one per core) or more, found {workers}")
    return min(workers or most_useful, max(1, most))  # a process takes seconds to start
