"""An edited scene written out: pictures, depth, instances, classes, labels, a video, and the log in others' forms.

Each frame is drawn by itself, in one of several processes, and is whole when its record `frames/NAME.json` is there; a
run that was stopped goes on with the frames that are not. `manifest.json` comes last.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from carstudio import __version__
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.files import parse_json, remove_partials, write_bytes, write_json, write_text
from carstudio.images import encode_depth, encode_png, read_image
from carstudio.locks import FolderLock
from carstudio.progress import Report, silent
from carstudio.report.video import write_mp4
from carstudio.scene.drawing import DrawnFrame, draw_frame, read_photo
from carstudio.scene.edit_page import write_edit_page
from carstudio.scene.edited_log import KITTI, TRANSFORMS, tracking_ids, write_kitti, write_transforms
from carstudio.scene.frame_jobs import DrawingSettings, FrameJob, Sensor, frame_job, instance_numbers
from carstudio.scene.graph import Scene, Vector3
from carstudio.scene.matching import gains_of, sensor_of
from carstudio.scene.shelf import CarShelf
from carstudio.scene.truth import label_line, truths_of

FORMAT, FORMAT_VERSION = "carstudio-edit", 1
MANIFEST, RECORDS = "manifest.json", "frames"
FPS = 10.0  # KITTI's frame rate
PICTURES = ("rgb", "depth", "instance", "semantic")


@dataclass(frozen=True, kw_only=True)
class EditSummary:
    """What was written. `kept` frames were whole from an earlier run."""

    out: Path
    num_frames: int
    kept: int
    drawn_tracks: tuple[str, ...]
    manifest: dict[str, Any]


@dataclass(frozen=True)
class FrameTask:
    """A frame for a worker: what to draw, where, and the key by which a finished frame is known again."""

    job: FrameJob
    out: Path
    key: str


def write_edited(
    original: Scene,
    edited: Scene,
    scene_folder: Path,
    out: Path,
    *,
    workers: int = 1,
    report: Report = silent,
    settings: DrawingSettings | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> EditSummary:
    """Draw all frames of `edited` below `out`; what `original` shows and `edited` does not is filled.

    `InputError` for an empty scene, for tracks that cannot be drawn, and for files that are not the scene's.
    """
    if not edited.frames:
        raise InputError("the scene has no frames; make it with at least one")
    with FolderLock(out):
        remove_partials(out)
        tasks = _tasks(original, edited, scene_folder, out, settings or DrawingSettings())
        records = {task.job.frame.index: record for task in tasks if (record := _whole(task)) is not None}
        kept, total = len(records), len(tasks)
        report("drawing frames", kept, total, f"{kept} kept" if kept else "")
        left = [task for task in tasks if task.job.frame.index not in records]
        with closing(ordered_map(write_frame, left, workers=workers)) as results:
            for record in results:
                records[record["frame"]] = record
                report("drawing frames", len(records), total, record["name"])
        ordered = [records[frame.index] for frame in edited.frames]
        manifest = _finish(original, edited, out, ordered, tasks[0].job.sensor, provenance or {}, report)
    drawn = tuple(manifest["drawn_tracks"])
    return EditSummary(out=out, num_frames=total, kept=kept, drawn_tracks=drawn, manifest=manifest)


def _tasks(original: Scene, edited: Scene, scene_folder: Path, out: Path, settings: DrawingSettings) -> list[FrameTask]:
    drawn = {name: track for name, track in edited.tracks.items() if track.is_drawn}
    sensor, gains = Sensor(), dict[str, Vector3]()
    if drawn and settings.is_matched:
        read = partial(read_photo, edited.root)
        sensor = sensor_of(original.frames, read)
        gains = gains_of(original, edited, foreign_tracks(original, edited, scene_folder), read)
    folder = str(scene_folder)
    jobs = [
        frame_job(original, edited, frame.index, folder, settings=settings, sensor=sensor, gains=gains)
        for frame in edited.frames
    ]
    return [FrameTask(job, out, _key(job)) for job in jobs]


def foreign_tracks(original: Scene, edited: Scene, scene_folder: Path) -> frozenset[str]:
    """Drawn tracks whose car was not lifted from this log: bundled ones, and those of other photographs.

    A recoloured car keeps the record of the log it was lifted from.
    """
    shelf, own = CarShelf(scene_folder), {track.car for track in original.tracks.values()}
    result = set()
    for name, track in edited.tracks.items():
        if track.is_drawn and track.car is not None and track.car not in own:
            if "scene_key" not in shelf.load(track.car).provenance:
                result.add(name)
    return frozenset(result)


def _key(job: FrameJob) -> str:
    """What a finished frame was made from: the same job gives the same key."""
    relevant = dataclasses.replace(job, scene_folder="")
    text = json.dumps([__version__, FORMAT_VERSION, dataclasses.asdict(relevant)], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _whole(task: FrameTask) -> dict[str, Any] | None:
    """The record of a frame that is finished and was made from this very job."""
    name = task.job.frame.name
    path = task.out / RECORDS / f"{name}.json"
    if not path.is_file() or not all((task.out / kind / f"{name}.png").is_file() for kind in PICTURES):
        return None
    try:
        record = parse_json(path.read_bytes(), name=str(path))
    except InputError:
        return None
    return record if isinstance(record, dict) and record.get("key") == task.key else None


def write_frame(task: FrameTask) -> dict[str, Any]:
    """Draw one frame and write its files, the record last."""
    job, out = task.job, task.out
    name = job.frame.name
    drawn = draw_frame(job)
    write_bytes(out / "rgb" / f"{name}.png", encode_png(drawn.rgb))
    write_bytes(out / "depth" / f"{name}.png", encode_depth(drawn.depth_m))
    write_bytes(out / "instance" / f"{name}.png", encode_png(drawn.instances))
    write_bytes(out / "semantic" / f"{name}.png", encode_png(drawn.semantic))
    lines = [label_line(truth, job.frame.camera_offset) for truth in drawn.truths]
    write_text(out / "label_2" / f"{name}.txt", "".join(f"{line}\n" for line in lines if line is not None))
    record = frame_record(job, drawn) | {"key": task.key}
    write_json(out / RECORDS / f"{name}.json", record)
    return record


def frame_record(job: FrameJob, drawn: DrawnFrame) -> dict[str, Any]:
    """What is known of a drawn frame, as JSON."""
    return {
        "frame": job.frame.index,
        "name": job.frame.name,
        "ground": drawn.ground_source,
        "touched_px": int(drawn.touched.sum()),
        "filled_px": drawn.filled_px,
        "filled_from_frames_px": drawn.filled_from_frames_px,
        "objects": [dataclasses.asdict(truth) for truth in drawn.truths],
    }


class PictureFiles(Sequence[UInt8[np.ndarray, "height width 3"]]):
    """Pictures of a folder, read when they are asked for."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        return read_image(self._paths[index])

    def __iter__(self) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
        return (read_image(path) for path in self._paths)


def _finish(
    original: Scene,
    edited: Scene,
    out: Path,
    records: Sequence[Mapping[str, Any]],
    sensor: Sensor,
    provenance: Mapping[str, Any],
    report: Report,
) -> dict[str, Any]:
    """Video, the log in other forms, the page, and the manifest last."""
    report("writing the log", 0, 3, "video")
    sizes = {(frame.width, frame.height) for frame in edited.frames}
    codec = None
    if len(sizes) == 1:
        codec = write_mp4(out / "video.mp4", PictureFiles([out / "rgb" / f"{r['name']}.png" for r in records]), FPS)
    report("writing the log", 1, 3, "KITTI, nerfstudio")
    ids = tracking_ids(original, edited)
    sequence = sequence_of(edited)
    labels: dict[int, list[tuple[int, str]]] = {}
    for frame, record in zip(edited.frames, records, strict=True):
        lines = ((ids[t.track_id], label_line(t, frame.camera_offset)) for t in truths_of(record))
        labels[frame.index] = sorted((number, line) for number, line in lines if line is not None)
    write_kitti(out / KITTI, sequence, edited.frames, labels)
    has_poses = write_transforms(out, edited.frames)
    report("writing the log", 2, 3, "page")
    drawn = sorted({o["track_id"] for record in records for o in record["objects"] if o["is_drawn"]})
    manifest = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "carstudio": __version__,
        "licence": edited.licence,
        "source": edited.source,
        "frames": [{key: record[key] for key in _IN_MANIFEST} for record in records],
        "instances": {name: number for name, number in instance_numbers(original, edited).items()},
        "tracking_ids": ids,
        "drawn_tracks": drawn,
        "removed_tracks": sorted(set(original.tracks) - set(edited.tracks)),
        "sensor": dataclasses.asdict(sensor),
        "video": None if codec is None else {"file": "video.mp4", "codec": codec, "fps": FPS},
        "kitti": {"folder": KITTI, "sequence": sequence, "poses": has_poses},
        "nerfstudio": TRANSFORMS if has_poses else None,
        "provenance": dict(provenance),
    }
    write_edit_page(original, edited, out, records, manifest)
    write_json(out / MANIFEST, manifest)
    report("writing the log", 3, 3, "")
    return manifest


_IN_MANIFEST = ("frame", "name", "ground", "touched_px", "filled_px", "filled_from_frames_px")


def sequence_of(scene: Scene) -> str:
    """The sequence a log is named by in KITTI's layout: the folder of its photographs, 0000 for others."""
    parts = scene.frames[0].image.path.split("/")
    return parts[-2] if len(parts) >= 3 and parts[-2].isdigit() else "0000"
