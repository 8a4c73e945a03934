"""What a build works through: sources and perception as the config names them, frame after frame."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from carstudio.dataset.candidates import FrameResult, records_of_frame
from carstudio.dataset.filters import DVM_CARS, FilterRecipe
from carstudio.dataset.known_boxes import make_box_estimator
from carstudio.dataset.legacy_json.importer import KEEP_RELEASED, SOURCE, LegacyJob, open_legacy
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.recognition import Perception, Pixels, recognise
from carstudio.dataset.sources.dvm_cars import open_dvm_cars
from carstudio.dataset.sources.frame import CameraOffset, Frame, FrameRef, Source
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.dataset.sources.photo_files import find_photos
from carstudio.dataset.sources.photos import open_photos
from carstudio.devices import one_thread, pick_device
from carstudio.errors import InputError
from carstudio.images import decode_image
from carstudio.perception.specs import make_detector, make_segmenter
from carstudio.progress import Report, silent

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
    """Who finds the 3-D boxes: labels (KITTI's default), dd3d:FOLDER (a converted checkpoint), precomputed:FOLDER
    (KITTI text), precomputed:FILE.json (DD3D's) or none (the default of photographs without labels)."""
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
    """Processes; 0 takes one per core, one where networks run on a GPU. Changes nothing in the result (on a CPU). Each
    has its own copy of the networks (SAM ViT-H: 2.6 GB)."""


@dataclass(frozen=True)
class FrameJob:
    """All that a process needs to turn frames into records."""

    source: Source
    perception: Perception
    types: tuple[str, ...]
    done: frozenset[str]  # patches that an interrupted build has written already

    def __call__(self, refs: tuple[FrameRef, ...]) -> FrameResult:
        """Records of a few frames, seen together by the detector; a broken frame becomes a problem."""
        with one_thread():  # networks' sums differ in last bits with the number of threads, and masks by a pixel
            return self._look_at(refs)

    def _look_at(self, refs: tuple[FrameRef, ...]) -> FrameResult:
        frames, pictures, problems = [], [], []
        for ref in refs:
            try:
                frame = self.source.load(ref)
                pictures.append(decode_image(frame.image, name=frame.image_path))
                frames.append(frame)
            except InputError as error:
                problems.append(f"frame {ref.stem} skipped: {error}")
        records: list[PatchRecord] = []
        for found, pixels in zip(self._recognise(frames, pictures), pictures, strict=True):
            if isinstance(found, str):
                problems.append(found)
                continue
            result = records_of_frame(
                found,
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

    def _recognise(self, frames: list[Frame], pictures: list[Pixels]) -> list[Frame | str]:
        """Each frame as perception sees it, or the problem it has with it; one by one where not all go together."""
        try:
            return list(recognise(frames, pictures, self.perception))
        except InputError as error:
            if len(frames) == 1:
                return [f"frame {frames[0].frame_id} skipped: {error}"]
        pairs = zip(frames, pictures, strict=True)
        return [self._recognise([frame], [picture])[0] for frame, picture in pairs]


@dataclass(frozen=True)
class Plan:
    """What a build works through, in order; `start` takes the ids of patches that are there already."""

    source: str
    num_items: int
    start: Callable[[frozenset[str]], tuple[Callable[[Any], FrameResult], Iterable[Any]]]  # the work, the items left
    chunk: int  # items handed to a process at once
    filters: FilterRecipe
    resume_key: str
    workers: int  # processes where nobody asks for a number
    finds_duplicates: bool  # look for pictures that repeat each other, so that none is in train and test
    problems: tuple[str, ...] = ()


def plan_frames(config: BuildConfig, inputs: str) -> Plan:
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
        resume_key=_resume_key(config, inputs),
        workers=1 if uses_accelerator(config) else os.cpu_count() or 1,
        finds_duplicates=config.source in UNLABELLED or config.filters.drop_duplicates,
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
        workers=os.cpu_count() or 1,
        finds_duplicates=False,
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


def input_places(config: BuildConfig) -> list[str | Path]:
    """Files and folders that decide the store."""
    root, places = Path(config.root), [config.root]
    if config.source == "photos":  # a list or pattern names photographs anywhere
        places += [photo.location for photo in find_photos(str(config.root))] if not root.is_dir() else []
    elif config.source in ("kitti-det", "kitti-mot"):  # other folders of KITTI's (velodyne) decide nothing
        images, labels = ("image_2", "label_2") if config.source == "kitti-det" else ("image_02", "label_02")
        base = root if (root / images).is_dir() else root / "training"
        places = [base / images / (config.sequence or ""), base / labels, base / "calib"]
    specs = (config.detector, config.segmenter, config.box3d, config.camera)
    named = [Path(spec.partition(":")[2]).expanduser() for spec in specs if spec and ":" in spec]
    return [*places, *(path for path in named if path.exists())]


def uses_accelerator(config: BuildConfig) -> bool:
    """Whether networks run on a GPU, which several processes would only crowd."""
    kinds = {spec.partition(":")[0] for spec in (config.detector, config.segmenter, config.box3d) if spec}
    is_networks = bool(kinds & {"transformers", "sam", "sam2", "dd3d"}) or (
        config.detector is None and config.source in UNLABELLED
    )
    return is_networks and pick_device("auto").type != "cpu"


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


def _resume_key(config: BuildConfig, *inputs: str) -> str:
    """What must be equal for an interrupted build to go on: all that decides the records."""
    settings = {key: value for key, value in asdict(config).items() if key not in ("out", "filters", "workers", "root")}
    return hashlib.sha256(json.dumps([settings, inputs], sort_keys=True).encode()).hexdigest()
