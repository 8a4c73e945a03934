"""`carstudio build`: a source of photographs in, a CarPatch3D store out.

Frames are worked on in processes and written in order, so that the number of workers changes no byte. An interrupted
build goes on where it stopped when it is started again with the same settings.
"""

import hashlib
import json
import os
import time
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

from carstudio.dataset.candidates import FrameResult, records_of_frame
from carstudio.dataset.filters import FilterRecipe, judge
from carstudio.dataset.runs import is_made_already, write_run
from carstudio.dataset.sources.frame import FrameRef, Source
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.dataset.splits import count_parts, write_splits
from carstudio.dataset.store import PatchStore, StoreWriter, open_store
from carstudio.dataset.summary import BuildSummary, count_reasons
from carstudio.dataset.verdicts import Verdict
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.locks import clear_leftovers
from carstudio.perception.results import Segmenter
from carstudio.perception.specs import make_segmenter
from carstudio.progress import Report, silent

__all__ = ["BuildConfig", "BuildSummary", "build"]

_CHUNK = 4  # frames handed to a process at once


@dataclass(frozen=True)
class BuildConfig:
    """What to build from what."""

    source: Literal["kitti-det", "kitti-mot"]
    """Kind of input."""
    root: Path
    """Folder of the source, in its official layout (the folder with image_2 or image_02, or its parent)."""
    out: Path
    """Folder of the store; must be new, empty or an unfinished store."""
    frames: str | None = None
    """Frame numbers A-B, both included; all when absent."""
    sequence: str | None = None
    """KITTI-MOT: one sequence, such as 0001; all when absent."""
    segmenter: str = "grabcut"
    """grabcut (needs no weights), onnx:FILE (better on real frames), precomputed:FOLDER or ground-truth."""
    types: tuple[str, ...] = ("Car",)
    """Label types that become candidates; objects of every type hide those behind them."""
    filters: FilterRecipe = field(default_factory=FilterRecipe)
    """Thresholds of the filters."""
    workers: int = 0
    """Processes; 0 takes one per core. Changes nothing in the result."""


@dataclass(frozen=True)
class FrameJob:
    """All that a process needs to turn frames into records."""

    source: Source
    segmenter: Segmenter
    types: tuple[str, ...]
    done: frozenset[str]  # patches that an interrupted build has written already

    def __call__(self, ref: FrameRef) -> FrameResult:
        """Records of one frame; a broken frame becomes a problem."""
        try:
            return records_of_frame(
                self.source.load(ref),
                self.segmenter,
                source=self.source.name,
                licence=self.source.licence,
                types=self.types,
                done=self.done,
            )
        except InputError as error:
            return FrameResult((), (f"frame {ref.stem} skipped: {error}",))


def build(config: BuildConfig, report: Report = silent) -> BuildSummary:
    """Make the store `config.out`; verdicts and splits are written at the end."""
    start = time.perf_counter()
    if is_made_already(config.out, asdict(config)):
        clear_leftovers(config.out)
        store = open_store(config.out)
        return summarize(store, source=config.source, verdicts=store.verdicts())
    source = open_source(config)
    segmenter = make_segmenter(config.segmenter)
    refs = source.frames()
    workers = _num_workers(config.workers, len(refs))
    problems = list(source.problems)
    with StoreWriter(config.out, source=source.name, resume_key=_resume_key(config)) as writer:
        write_run(config.out, asdict(config))
        job = FrameJob(source, segmenter, config.types, writer.ids())
        with closing(ordered_map(job, refs, workers=workers, chunk=_CHUNK)) as results:
            for done, result in enumerate(results, start=1):
                for record in result.records:
                    writer.append(record)
                problems += result.problems
                report("build", done, len(refs), f"{len(writer)} candidates")
        verdicts = judge_and_split(writer, config.filters)
    summary = summarize(open_store(config.out), source=source.name, verdicts=verdicts)
    return replace(summary, problems=tuple(problems), seconds=time.perf_counter() - start)


def open_source(config: BuildConfig) -> Source:
    """The source that the config names."""
    if config.source == "kitti-det":
        if config.sequence is not None:
            raise InputError("--sequence is for kitti-mot; kitti-det has no sequences")
        return open_kitti_det(config.root, frames=config.frames)
    return open_kitti_mot(config.root, sequence=config.sequence, frames=config.frames)


def judge_and_split(writer: StoreWriter, recipe: FilterRecipe) -> list[Verdict]:
    """Verdicts and splits of all that was written: before the writer closes, so that "finished" comes last.

    A run killed before that is unfinished and goes on when it is started again.
    """
    writer.flush()
    store = open_store(writer.path, lock=writer.lock)
    verdicts = judge_store(store, recipe)
    write_splits(store)
    return verdicts


def judge_store(store: PatchStore, recipe: FilterRecipe) -> list[Verdict]:
    """Judge every patch again by its stored values and replace the store's verdicts."""
    verdicts = [judge(record, recipe) for record in store.light_records()]
    store.write_verdicts(verdicts)
    return verdicts


def summarize(store: PatchStore, *, source: str, verdicts: list[Verdict]) -> BuildSummary:
    """Count everything in a finished store."""
    info = store.info()
    return BuildSummary(
        out=store.path,
        source=source,
        candidates=len(store),
        kept=info["kept"],
        instances=info["kept_instances"],
        reasons=count_reasons(verdicts),
        splits={name: count_parts(store.split(name)) for name in store.split_names()},
    )


def _resume_key(config: BuildConfig) -> str:
    """What must be equal for an interrupted build to go on: all that decides the records."""
    settings = {key: value for key, value in asdict(config).items() if key not in ("out", "filters", "workers", "root")}
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _num_workers(workers: int, num_frames: int) -> int:
    if workers < 0:
        raise InputError(f"--workers must be 0 (one per core) or more, found {workers}")
    return min(workers or os.cpu_count() or 1, max(1, num_frames // 8))  # a process takes seconds to start
