"""The simulation gap: does a detector see drawn cars as it sees photographed ones?

The same detector on the photographs, on their replay and on edited frames, each against its own truth.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from carstudio.evaluation.tables import Cell, Table, to_markdown
from carstudio.files import read_json, write_json, write_text
from carstudio.geometry.overlap import box2d_iou
from carstudio.images import read_image
from carstudio.perception.results import Box2D, Detector, Photo
from carstudio.progress import Report, silent
from carstudio.scene.drawing import read_photo
from carstudio.scene.graph import Scene, SceneFrame
from carstudio.scene.truth import truths_of
from carstudio.scene.writing import RECORDS

NAME = "simulation_gap"
LEAST_HEIGHT_PX, MOST_OCCLUSION = 25.0, 1  # KITTI's "moderate" objects
MATCH_IOU = 0.5
VEHICLES = ("Car", "Van", "Truck")


@dataclass(frozen=True)
class TruthBox:
    """A vehicle that a detector should find."""

    track_id: str
    box2d: Box2D
    is_drawn: bool


@dataclass(frozen=True)
class GapFrame:
    """A picture with what stands in it."""

    index: int
    image: UInt8[np.ndarray, "height width 3"]
    truth: tuple[TruthBox, ...]


@dataclass(frozen=True, kw_only=True)
class GapRow:
    """What a detector finds of a set of frames: counts, recall, mean confidence of what it found."""

    name: str
    frames: int
    boxes: int
    found: int
    recall: float | None
    confidence: float | None
    drawn_boxes: int
    drawn_recall: float | None
    drawn_confidence: float | None


def original_frames(scene: Scene) -> Iterable[GapFrame]:
    """The photographs with their labels."""
    for frame in scene.frames:
        truth = []
        for name, track in scene.tracks.items():
            label = track.labels.get(frame.index)
            if label is None or track.type not in VEHICLES or not label.get("box2d"):
                continue
            occlusion = label.get("occlusion")
            x0, y0, x1, y1 = (float(value) for value in label["box2d"])
            if y1 - y0 >= LEAST_HEIGHT_PX and occlusion is not None and 0 <= occlusion <= MOST_OCCLUSION:
                truth.append(TruthBox(name, (x0, y0, x1, y1), False))
        yield GapFrame(frame.index, read_photo(scene.root, frame), tuple(truth))


def edited_frames(frames: Sequence[SceneFrame], out: Path) -> Iterable[GapFrame]:
    """Frames that `write_edited` wrote, with their new truth."""
    for frame in frames:
        record = read_json(out / RECORDS / f"{frame.name}.json")
        truth = tuple(
            TruthBox(found.track_id, found.box2d, found.is_drawn)
            for found in truths_of(record)
            if found.box2d is not None
            and found.type in VEHICLES
            and found.occlusion <= MOST_OCCLUSION
            and found.box2d[3] - found.box2d[1] >= LEAST_HEIGHT_PX
        )
        yield GapFrame(frame.index, read_image(out / "rgb" / f"{frame.name}.png"), truth)


def measure(
    name: str, frames: Iterable[GapFrame], detector: Detector, *, total: int, report: Report = silent
) -> tuple[GapRow, dict[tuple[int, str], float]]:
    """A row, and the confidence (0: not found) of every (frame, track)."""
    scores: dict[tuple[int, str], float] = {}
    drawn: set[tuple[int, str]] = set()
    count = 0
    for count, frame in enumerate(frames, start=1):
        report(f"detecting: {name}", count, total, "")
        photo = Photo(image=frame.image, frame_id=str(frame.index), path="", intrinsics=(1.0, 1.0, 0.0, 0.0))
        detections = detector.detect([photo])[0]
        boxes = [detection.box2d for detection in detections if detection.type in VEHICLES]
        sure = [detection.score for detection in detections if detection.type in VEHICLES]
        found = match([truth.box2d for truth in frame.truth], boxes)
        for truth, hit in zip(frame.truth, found, strict=True):
            scores[frame.index, truth.track_id] = sure[hit] if hit is not None else 0.0
            if truth.is_drawn:
                drawn.add((frame.index, truth.track_id))
    recall, confidence = _figures(list(scores.values()))
    drawn_recall, drawn_confidence = _figures([scores[key] for key in drawn])
    row = GapRow(
        name=name,
        frames=count,
        boxes=len(scores),
        found=sum(score > 0 for score in scores.values()),
        recall=recall,
        confidence=confidence,
        drawn_boxes=len(drawn),
        drawn_recall=drawn_recall,
        drawn_confidence=drawn_confidence,
    )
    return row, scores


def _figures(scores: Sequence[float]) -> tuple[float | None, float | None]:
    found = [score for score in scores if score > 0]
    recall = round(len(found) / len(scores), 4) if scores else None
    return recall, round(sum(found) / len(found), 4) if found else None


def match(truth: Sequence[Box2D], boxes: Sequence[Box2D]) -> list[int | None]:
    """For each true box the number of the detection that is its own, or None.

    Detections come in descending order of confidence; each takes the free true box that it overlaps most (IoU at least
    0.5), as KITTI's and COCO's evaluations do.
    """
    result: list[int | None] = [None] * len(truth)
    if not truth or not boxes:
        return result
    iou = box2d_iou(torch.tensor(boxes)[:, None], torch.tensor(truth)[None])
    for number in range(len(boxes)):
        free = [i for i in range(len(truth)) if result[i] is None and float(iou[number, i]) >= MATCH_IOU]
        if free:
            result[max(free, key=iou[number].tolist().__getitem__)] = number
    return result


def simulation_gap(
    scene: Scene, edited: dict[str, Path], detector: Detector, out: Path, *, report: Report = silent
) -> tuple[GapRow, ...]:
    """The table of the photographs and of each edited folder (name -> folder); writes simulation_gap.json and .md."""
    sets: list[tuple[str, Iterable[GapFrame]]] = [("photographs", original_frames(scene))]
    sets += [(name, edited_frames(scene.frames, folder)) for name, folder in edited.items()]
    rows, by_name = [], {}
    for name, frames in sets:
        row, scores = measure(name, frames, detector, total=len(scene.frames), report=report)
        rows.append(row)
        by_name[name] = scores
    pairs = {name: _paired(by_name["photographs"], by_name[name]) for name in edited}
    value: dict[str, Any] = {"rows": [asdict(row) for row in rows], "same_objects": pairs}
    write_json(out / f"{NAME}.json", value)
    write_text(out / f"{NAME}.md", to_markdown(gap_table(rows, pairs)) + "\n")
    return tuple(rows)


def _paired(photographs: dict[tuple[int, str], float], drawn: dict[tuple[int, str], float]) -> dict[str, float | int]:
    """Recall of the objects that stand in both, in each of the two."""
    both = sorted(photographs.keys() & drawn.keys())
    count = max(1, len(both))
    return {
        "boxes": len(both),
        "recall_photographs": round(sum(photographs[key] > 0 for key in both) / count, 4),
        "recall": round(sum(drawn[key] > 0 for key in both) / count, 4),
    }


def gap_table(rows: Sequence[GapRow], pairs: dict[str, dict[str, float | int]]) -> Table:
    """Recall and confidence, side by side."""
    of_drawn = ("drawn", "recall of drawn ↑", "confidence of drawn")
    heads = ("frames", "vehicles", "found", "recall ↑", "confidence", *of_drawn)

    def text(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    cells = []
    for row in rows:
        known = [row.name, str(row.boxes), str(row.found), text(row.recall), text(row.confidence)]
        drawn = [str(row.drawn_boxes), text(row.drawn_recall), text(row.drawn_confidence)]
        cells.append(tuple(Cell(value) for value in known + drawn))
    notes = [
        f"Vehicles at least {LEAST_HEIGHT_PX:.0f} px high and at most partly occluded; found: a detection with an IoU "
        f"of at least {MATCH_IOU}. Confidence: mean over what is found. Photographs: the log's labels; others: boxes "
        "of what is visible."
    ]
    for name, pair in pairs.items():
        notes.append(
            f"The {pair['boxes']} vehicles that are in both: recall {pair['recall_photographs']:.3f} in the "
            f"photographs, {pair['recall']:.3f} in {name}."
        )
    return Table("Simulation gap: one detector on photographed and drawn cars", heads, tuple(cells), tuple(notes))
