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
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from carstudio.dataset.candidates import FrameResult, records_of_frame
from carstudio.dataset.filters import DVM_CARS, FilterRecipe, judge
from carstudio.dataset.known_boxes import make_box_estimator
from carstudio.dataset.legacy_json.importer import KEEP_RELEASED, SOURCE, LegacyJob, open_legacy
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.recognition import Perception, recognise
from carstudio.dataset.runs import is_made_already, write_run
from carstudio.dataset.sources.dvm_cars import open_dvm_cars
from carstudio.dataset.sources.frame import CameraOffset, FrameRef, Source
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.dataset.sources.photos import open_photos
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PARTS, PatchStore, StoreWriter, open_store
from carstudio.dataset.summary import BuildSummary
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.images import decode_image
from carstudio.locks import clear_leftovers
from carstudio.perception.specs import make_detector, make_segmenter
from carstudio.progress import Report, silent

__all__ = ["BuildConfig", "BuildSummary", "build"]

SourceKind = Literal["kitti-det", "kitti-mot", "dvm-cars", "photos", "legacy-json"]
UNLABELLED = ("photos", "dvm-cars")  # sources whose cars a detector must find
_FRAMES_PER_CHUNK = 4  # handed to a process, and shown to a detector, at once
_RECORDS_PER_CHUNK = 32  # of the authors' json: a fraction of a frame's work each


@dataclass(frozen=True)
class BuildConfig:
    """What to build from what."""

    source: SourceKind
    """Kind of input."""
    root: str | Path
    """Folder of the source, in its official layout (the folder with image_2 or image_02, or its parent); photos: a
    folder, a pattern, a list (txt, csv, parquet) or a URL; legacy-json: one of the authors' json files, or the folder
    that holds them."""
    out: Path
    """Folder of the store; must be new, empty or an unfinished store."""
    frames: str | None = None
    """Frame numbers A-B, both included (photos: counted from 0); all when absent."""
    sequence: str | None = None
    """KITTI-MOT: one sequence, such as 0001; all when absent."""
    subset: str | None = None
    """legacy-json: one of km, ko, dv, vk, ns; all that are there when absent."""
    camera_offset: CameraOffset = "exact"
    """exact: boxes are moved by K^-1 P2[:, 3], as KITTI's projection says; as-released: they are not."""
    detector: str | None = None
    """Who finds the 2-D boxes: labels (KITTI's default), transformers[:NAME_OR_DIR] (the default of photographs
    without labels), onnx:FILE (YOLOX) or precomputed:FILE.json (COCO)."""
    box3d: str | None = None
    """Who finds the 3-D boxes: labels (KITTI's default), precomputed:FOLDER (KITTI text), precomputed:FILE.json (DD3D)
    or none (the default of photographs without labels)."""
    camera: str | None = None
    """exif, paper, FOCAL_PX, FX,FY,CX,CY or calib:PATH; absent: KITTI's own calibration, exif of photos,
    paper for dvm-cars."""
    licence: str | None = None
    """photos: their licence, such as CC-BY-4.0; stored with every patch."""
    segmenter: str = "grabcut"
    """grabcut (needs no weights), onnx:FILE (better on real frames), sam:NAME_OR_DIR, sam2:NAME_OR_DIR,
    precomputed:FOLDER, precomputed:FILE.json (COCO) or ground-truth."""
    types: tuple[str, ...] = ("Car",)
    """Label types that become candidates; objects of every type hide those behind them."""
    filters: FilterRecipe = field(default_factory=FilterRecipe)
    """Thresholds of the filters; for dvm-cars the defaults are those released for it (`DVM_CARS`). legacy-json keeps
    what the authors released, `dataset refilter` judges it again."""
    workers: int = 0
    """Processes; 0 takes one per core. Changes nothing in the result."""


@dataclass(frozen=True)
class FrameJob:
    """All that a process needs to turn frames into records."""

    source: Source
    perception: Perception
    types: tuple[str, ...]
    done: frozenset[str]  # patches that an interrupted build has written already

    def __call__(self, refs: tuple[FrameRef, ...]) -> FrameResult:
        """Records of a few frames, seen together by the detector; a broken frame becomes a problem."""
        frames, pictures, problems = [], [], []
        for ref in refs:
            try:
                frame = self.source.load(ref)
                pictures.append(decode_image(frame.image, name=frame.image_path))
                frames.append(frame)
            except InputError as error:
                problems.append(f"frame {ref.stem} skipped: {error}")
        records: list[PatchRecord] = []
        for frame, pixels in zip(recognise(frames, pictures, self.perception), pictures, strict=True):
            result = records_of_frame(
                frame,
                self.perception.segmenter,
                source=self.source.name,
                licence=self.source.licence,
                types=self.types,
                done=self.done,
                pixels=pixels,
            )
            records += result.records
            problems += result.problems
        return FrameResult(tuple(records), tuple(problems), num_items=len(refs))


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
            done = 0
            for result in results:
                for record in result.records:
                    writer.append(record)
                problems += result.problems
                done += result.num_items
                report("build", done, plan.num_items, f"{len(writer)} candidates")
        judge_and_split(writer, plan.filters)
    summary = summarize(open_store(config.out), source=plan.source)
    return replace(summary, problems=tuple(problems), seconds=time.perf_counter() - start)


def plan_frames(config: BuildConfig) -> Plan:
    """Photographs, with labels or without: every frame is looked at and segmented."""
    source, perception = open_source(config), make_perception(config)
    refs = source.frames()
    together = 1 if perception.detector is None else _FRAMES_PER_CHUNK
    batches = [tuple(refs[i : i + together]) for i in range(0, len(refs), together)]
    return Plan(
        source=source.name,
        num_items=len(refs),
        start=lambda done: (FrameJob(source, perception, config.types, done), batches),
        chunk=_FRAMES_PER_CHUNK // together,
        filters=DVM_CARS if config.source == "dvm-cars" and config.filters == FilterRecipe() else config.filters,
        resume_key=_resume_key(config),
        problems=source.problems,
    )


def plan_legacy(config: BuildConfig, report: Report = silent) -> Plan:
    """The authors' records: nothing is segmented, everything is kept."""
    defaults = {field.name: field.default for field in fields(BuildConfig)}
    for name in ("frames", "sequence", "detector", "box3d", "camera", "licence", "segmenter", "types"):
        default = defaults[name]
        if getattr(config, name) != default:
            raise InputError(
                f"--{name} is for sources with photographs; legacy-json takes patches and masks as they are"
            )
    if config.filters != FilterRecipe():
        raise InputError(
            "legacy-json keeps all that the authors released, no thresholds apply; build without them, then judge the "
            "store again with `carstudio dataset refilter STORE` and the thresholds"
        )
    source = open_legacy(Path(config.root), subset=config.subset, report=report)
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
    if config.sequence is not None and config.source != "kitti-mot":
        raise InputError(f"--sequence is for kitti-mot; {config.source} has no sequences")
    frames, camera_offset = config.frames, config.camera_offset
    if config.source == "photos":
        return open_photos(
            str(config.root),
            camera=config.camera or "exif",
            camera_offset=camera_offset,
            frames=frames,
            licence=config.licence,
        )
    if config.licence is not None:
        raise InputError(f"--licence is for photos; {config.source} has its own")
    if config.source == "dvm-cars":
        return open_dvm_cars(
            Path(config.root), camera=config.camera or "paper", camera_offset=camera_offset, frames=frames
        )
    if config.camera is not None:
        raise InputError(f"--camera is for photos and dvm-cars; {config.source} has its own calibration")
    if config.source == "kitti-det":
        return open_kitti_det(Path(config.root), frames=frames, camera_offset=camera_offset)
    assert config.source == "kitti-mot", config.source
    return open_kitti_mot(Path(config.root), sequence=config.sequence, frames=frames, camera_offset=camera_offset)


def make_perception(config: BuildConfig) -> Perception:
    """The components that the config names; each is tried before the build begins."""
    has_labels = config.source not in UNLABELLED
    detector = config.detector or ("labels" if has_labels else "transformers")
    box3d = config.box3d or ("labels" if has_labels else "none")
    if not has_labels and "labels" in (detector, box3d):
        what = "--detector" if detector == "labels" else "--box3d"
        raise InputError(f"{what} labels: {config.source} has no labels; name a detector, or precomputed: results")
    return Perception(
        segmenter=make_segmenter(config.segmenter),
        detector=None if detector == "labels" else make_detector(detector),
        boxes=None if box3d == "labels" else make_box_estimator(box3d),
        uses_label_boxes=box3d == "labels",
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
