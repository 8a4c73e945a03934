"""`carstudio build`: a source of photographs in, a CarPatch3D store out.

Frames are worked on in processes and written in order, so that the number of workers changes no byte. An interrupted
build goes on where it stopped when it is started again with the same settings.
"""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from carstudio.dataset.candidates import FrameResult, records_of_frame
from carstudio.dataset.filters import FilterRecipe, judge
from carstudio.dataset.legacy_json.importer import KEEP_RELEASED, SOURCE, LegacyJob, open_legacy
from carstudio.dataset.runs import is_made_already, write_run
from carstudio.dataset.sources.frame import CameraOffset, FrameRef, Source
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PARTS, PatchStore, StoreWriter, open_store
from carstudio.dataset.summary import BuildSummary
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.locks import clear_leftovers
from carstudio.perception.results import Segmenter
from carstudio.perception.specs import make_segmenter
from carstudio.progress import Report, silent

__all__ = ["BuildConfig", "BuildSummary", "build"]

_FRAMES_PER_CHUNK = 4  # handed to a process at once
_RECORDS_PER_CHUNK = 32  # of the authors' json: a fraction of a frame's work each


@dataclass(frozen=True)
class BuildConfig:
    """What to build from what."""

    source: Literal["kitti-det", "kitti-mot", "legacy-json"]
    """Kind of input."""
    root: Path
    """Folder of the source, in its official layout (the folder with image_2 or image_02, or its parent); legacy-json:
    one of the authors' json files, or the folder that holds them."""
    out: Path
    """Folder of the store; must be new, empty or an unfinished store."""
    frames: str | None = None
    """Frame numbers A-B, both included; all when absent."""
    sequence: str | None = None
    """KITTI-MOT: one sequence, such as 0001; all when absent."""
    subset: str | None = None
    """legacy-json: one of km, ko, dv, vk, ns; all that are there when absent."""
    camera_offset: CameraOffset = "exact"
    """exact: boxes are moved by K^-1 P2[:, 3], as KITTI's projection says; as-released: they are not."""
    segmenter: str = "grabcut"
    """grabcut (needs no weights), onnx:FILE (better on real frames), precomputed:FOLDER or ground-truth."""
    types: tuple[str, ...] = ("Car",)
    """Label types that become candidates; objects of every type hide those behind them."""
    filters: FilterRecipe = field(default_factory=FilterRecipe)
    """Thresholds of the filters; legacy-json keeps what the authors released, `dataset refilter` judges it again."""
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


@dataclass(frozen=True)
class Plan:
    """What a build works through, in order; `start` takes the ids of patches that are there already."""

    source: str
    num_items: int
    start: Callable[[frozenset[str]], tuple[Callable[[Any], FrameResult], Iterable[Any]]]  # the work, the items left
    chunk: int  # items handed to a process at once
    filters: FilterRecipe
    resume_key: str
    problems: tuple[str, ...] = ()


def build(config: BuildConfig, report: Report = silent) -> BuildSummary:
    """Make the store `config.out`; verdicts and splits are written at the end."""
    start = time.perf_counter()
    if is_made_already(config.out, asdict(config)):
        clear_leftovers(config.out)
        return summarize(open_store(config.out), source=config.source)
    plan = plan_legacy(config, report) if config.source == "legacy-json" else plan_frames(config)
    workers = _num_workers(config.workers, plan.num_items // (2 * plan.chunk))
    problems = list(plan.problems)
    with StoreWriter(config.out, source=plan.source, resume_key=plan.resume_key) as writer:
        write_run(config.out, asdict(config))
        work, items = plan.start(writer.ids())
        with closing(ordered_map(work, items, workers=workers, chunk=plan.chunk)) as results:
            for done, result in enumerate(results, start=1):
                for record in result.records:
                    writer.append(record)
                problems += result.problems
                report("build", done, plan.num_items, f"{len(writer)} candidates")
        judge_and_split(writer, plan.filters)
    summary = summarize(open_store(config.out), source=plan.source)
    return replace(summary, problems=tuple(problems), seconds=time.perf_counter() - start)


def plan_frames(config: BuildConfig) -> Plan:
    """Photographs with labels: every frame is segmented."""
    source = open_source(config)
    segmenter = make_segmenter(config.segmenter)
    refs = source.frames()
    return Plan(
        source=source.name,
        num_items=len(refs),
        start=lambda done: (FrameJob(source, segmenter, config.types, done), refs),
        chunk=_FRAMES_PER_CHUNK,
        filters=config.filters,
        resume_key=_resume_key(config),
        problems=source.problems,
    )


def plan_legacy(config: BuildConfig, report: Report = silent) -> Plan:
    """The authors' records: nothing is segmented, everything is kept."""
    for name, default in (("frames", None), ("sequence", None), ("segmenter", "grabcut"), ("types", ("Car",))):
        if getattr(config, name) != default:
            raise InputError(
                f"--{name} is for sources with photographs; legacy-json takes patches and masks as they are"
            )
    if config.filters != FilterRecipe():
        raise InputError(
            "legacy-json keeps all that the authors released, no thresholds apply; build without them, then judge the "
            "store again with `carstudio dataset refilter STORE` and the thresholds"
        )
    source = open_legacy(config.root, subset=config.subset, report=report)
    return Plan(
        source=SOURCE,
        num_items=source.num_instances,
        start=lambda done: (LegacyJob(source.folder, config.camera_offset), source.items(done)),
        chunk=_RECORDS_PER_CHUNK,
        filters=KEEP_RELEASED,
        resume_key=_resume_key(config, *(file.sha256 for file in source.files)),
    )


def open_source(config: BuildConfig) -> Source:
    """The photographs that the config names."""
    if config.subset is not None:
        raise InputError(f"--subset is for legacy-json; {config.source} has no subsets")
    if config.source == "kitti-det":
        if config.sequence is not None:
            raise InputError("--sequence is for kitti-mot; kitti-det has no sequences")
        return open_kitti_det(config.root, frames=config.frames, camera_offset=config.camera_offset)
    assert config.source == "kitti-mot", config.source
    return open_kitti_mot(
        config.root, sequence=config.sequence, frames=config.frames, camera_offset=config.camera_offset
    )


def judge_and_split(writer: StoreWriter, recipe: FilterRecipe) -> None:
    """Verdicts and splits of all that was written: before the writer closes, so that "finished" comes last.

    A run killed before that is unfinished and goes on when it is started again.
    """
    writer.flush()
    store = open_store(writer.path, lock=writer.lock)
    judge_store(store, recipe)
    write_splits(store)


def judge_store(store: PatchStore, recipe: FilterRecipe) -> None:
    """Judge every patch again by its stored values and replace the store's verdicts."""
    store.write_verdicts(judge(record, recipe) for record in store.light_records())


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


def _resume_key(config: BuildConfig, *inputs: str) -> str:
    """What must be equal for an interrupted build to go on: all that decides the records."""
    settings = {key: value for key, value in asdict(config).items() if key not in ("out", "filters", "workers", "root")}
    return hashlib.sha256(json.dumps([settings, inputs], sort_keys=True).encode()).hexdigest()


def _num_workers(workers: int, most: int) -> int:
    if workers < 0:
        raise InputError(f"--workers must be 0 (one per core) or more, found {workers}")
    return min(workers or os.cpu_count() or 1, max(1, most))  # a process takes seconds to start
