"""3-D boxes: those that others found, read from their files (KITTI text, DD3D's JSON), and who finds them here.

A photograph without an entry simply has no boxes; its patches stay, with that as their verdict.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from carstudio.dataset.sources.cameras import beside
from carstudio.dataset.sources.kitti_format import DONT_CARE, center_in_camera, parse_labels, read_text
from carstudio.errors import InputError
from carstudio.files import read_json
from carstudio.geometry.transforms import rotation_from_quaternion
from carstudio.perception.dd3d.adapter import DD3D_FROM_CAR, Dd3dEstimator, upright
from carstudio.perception.dd3d.weights import load_dd3d
from carstudio.perception.results import BoxEstimator, Detection3D, Photo
from carstudio.perception.specs import parse_spec
from carstudio.perception.vehicle_classes import vehicle_type

BOX3D_SPECS = ("labels", "none", "dd3d:FOLDER", "precomputed:FOLDER", "precomputed:FILE.json")


@dataclass(frozen=True)
class KittiBoxes:
    """A folder of KITTI text: labels (15 columns) or a detector's results (16, the score in 0 to 1)."""

    folder: Path

    def estimate(self, photo: Photo) -> list[Detection3D]:
        """The file FRAME.txt, its boxes carried from the label frame to the camera by the photograph's offset."""
        file = beside(self.folder, photo.path, photo.frame_id, ".txt")
        if file is None:
            return []
        boxes = []
        for label in parse_labels(read_text(file, "label file"), name=file.name):
            center = center_in_camera(label, photo.camera_offset)
            if label.type == DONT_CARE or center is None or label.size is None:
                continue
            if label.score is not None and not 0 <= label.score <= 1:
                raise InputError(f"{file}: scores must lie between 0 and 1, found {label.score}; scale them")
            boxes.append(
                Detection3D(
                    box2d=label.box2d,
                    type=vehicle_type(label.type) or label.type,
                    center=center,
                    size=label.size,
                    yaw=label.yaw_rad,
                    score=label.score,
                )
            )
        return boxes


@dataclass(frozen=True)
class Dd3dBoxes:
    """DD3D's `bbox3d_predictions.json`: quaternion, centre in the camera frame, and size (width, length, height)."""

    file: Path

    def estimate(self, photo: Photo) -> list[Detection3D]:
        """Its boxes of this photograph, which it knows by its image id or by its file's name."""
        table = read_dd3d(str(self.file))
        for name in (photo.path, photo.frame_id, PurePosixPath(photo.path).name):
            if name in table:
                return list(table[name])
        return []


@lru_cache(maxsize=2)
def read_dd3d(file: str) -> dict[str, tuple[Detection3D, ...]]:
    """Boxes by image id and by the name of the image's file, best first."""
    content = read_json(Path(file))
    if not isinstance(content, list):
        raise InputError(f"{file}: expected a list of DD3D's predictions, found {type(content).__name__}")
    table: dict[str, list[Detection3D]] = {}
    for index, record in enumerate(content):
        where = f"{file} [{index}]"
        if not isinstance(record, dict) or not isinstance(record.get("category"), str):
            raise InputError(f"{where}: expected category, bbox3d, bbox, score_3d, image_id, found {record!r:.60}")
        kind = vehicle_type(record["category"])
        if kind is None:
            continue
        box = _dd3d_box(record, kind, where)
        names = [record.get("image_id"), record.get("file_name")]
        found = {PurePosixPath(name).name for name in names if isinstance(name, str)}
        found |= {str(name) for name in names if isinstance(name, (int, str))}
        for name in found:
            table.setdefault(name, []).append(box)
    return {name: tuple(sorted(boxes, key=lambda box: -(box.score or 0.0))) for name, boxes in table.items()}


def _dd3d_box(record: dict[str, Any], kind: str, where: str) -> Detection3D:
    numbers, box = record.get("bbox3d"), record.get("bbox")
    if not _are_numbers(numbers, 10) or not _are_numbers(box, 4):
        raise InputError(f"{where}: bbox3d must have 10 numbers and bbox 4, found {numbers!r:.80} and {box!r:.60}")
    assert isinstance(numbers, list)
    assert isinstance(box, list)
    width, length, height = numbers[7:]
    if min(width, length, height, *box[2:]) <= 0 or not 0.9 < math.hypot(*numbers[:4]) < 1.1:
        raise InputError(f"{where}: expected a unit quaternion and positive sizes, found {numbers!r:.120}")
    score = record.get("score_3d", record.get("score"))
    if not isinstance(score, float) or not 0 <= score <= 1:
        raise InputError(f"{where}: score_3d must lie between 0 and 1, found {score!r:.40}")
    turn = rotation_from_quaternion(torch.tensor(numbers[:4], dtype=torch.float64))
    yaw, quaternion = upright(turn @ torch.tensor(DD3D_FROM_CAR, dtype=torch.float64))
    return Detection3D(
        box2d=(box[0], box[1], box[0] + box[2], box[1] + box[3]),
        type=kind,
        center=(numbers[4], numbers[5], numbers[6]),
        size=(length, height, width),
        yaw=yaw,
        rotation=quaternion,
        score=score,
    )


def _are_numbers(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value)
    )


def make_box_estimator(spec: str) -> BoxEstimator | None:
    """Who finds the 3-D boxes; None for `none` (patches stay without one)."""
    kind, argument = parse_spec(spec)
    if kind == "none" and argument is None:
        return None
    if kind == "precomputed" and argument is not None:
        path = Path(argument)
        if path.is_dir():
            return KittiBoxes(path)
        if path.is_file() and path.suffix == ".json":
            read_dd3d(str(path))
            return Dd3dBoxes(path)
        raise InputError(f"--box3d {spec}: no folder of KITTI text (FRAME.txt) and no JSON file of DD3D's there")
    if kind == "dd3d" and argument is not None:
        folder = Path(argument).expanduser()
        load_dd3d(folder)
        return Dd3dEstimator(folder=folder)
    raise InputError(f"--box3d {spec!r}: expected one of {', '.join(BOX3D_SPECS)}")
