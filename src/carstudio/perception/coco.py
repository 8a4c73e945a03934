"""Boxes and masks that another program found, as COCO JSON: a results list (Detectron2 and most others write it), or a
whole annotation file with its images and categories.

A result belongs to a photograph by its image's file name, by the photograph's id, or by its number (000123.png is 123).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool
from skimage.draw import polygon2mask

from carstudio.errors import InputError
from carstudio.files import read_json
from carstudio.perception.hulls import occluded_pixels
from carstudio.perception.results import Box2D, Detection2D, MaskResult, Photo, SegmentRequest
from carstudio.perception.rle import decode_rle
from carstudio.perception.vehicles import COCO_CATEGORY_IDS, vehicle_type

SAME_OBJECT_IOU = 0.5  # of a box asked for and the box that a mask was found with


@dataclass(frozen=True)
class CocoResult:
    """One vehicle of a results file; `segmentation` is run lengths, polygons or None, `where` names it in messages."""

    detection: Detection2D
    segmentation: Any
    where: str


Results = dict[str, tuple[CocoResult, ...]]  # by image: file name, id or number as text


@dataclass(frozen=True)
class CocoDetector:
    """The boxes of a file."""

    file: Path

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        """A photograph of which the file says nothing has no cars."""
        results = read_results(str(self.file))
        return [_inside(results_of(results, photo.path, photo.frame_id), photo) for photo in photos]


@dataclass(frozen=True)
class CocoSegmenter:
    """The masks of a file: that of the result whose box is the car's."""

    file: Path

    def segment(self, request: SegmentRequest) -> MaskResult:
        """`InputError` when no result overlaps the car's box, or the one that does has no mask."""
        found = results_of(read_results(str(self.file)), request.photo_path, request.frame_id)
        overlaps = [_iou(result.detection.box2d, request.box2d) for result in found]
        if not overlaps or max(overlaps) < SAME_OBJECT_IOU:
            raise InputError(f"{self.file}: no result of {request.frame_id} overlaps its box {request.box2d}")
        result = found[int(np.argmax(overlaps))]
        whole = _mask(result, request.image.shape[:2])
        unknown = occluded_pixels(request, request.window)
        car = whole[request.window.slices] & ~unknown
        return MaskResult(car, unknown, result.detection.score)


def results_of(results: Results, path: str, frame_id: str) -> tuple[CocoResult, ...]:
    """The results of one photograph, by the first of its names that the file knows."""
    pure = PurePosixPath(path)
    names = [path, frame_id]
    if pure.stem == frame_id:  # no other photograph has this name
        names += [pure.name, str(int(pure.stem))] if pure.stem.isdecimal() else [pure.name]
    return next((results[name] for name in names if name in results), ())


@lru_cache(maxsize=2)
def read_results(file: str) -> Results:
    """All vehicles of a results list or annotation file by image, best first; `InputError` names what is malformed."""
    content = read_json(Path(file))
    if isinstance(content, dict):
        images = _named(content, "images", "file_name", file)
        kinds = {number: vehicle_type(name) for number, name in _named(content, "categories", "name", file).items()}
        records = content.get("annotations")
    else:
        images, kinds, records = {}, dict(COCO_CATEGORY_IDS), content
    if not isinstance(records, list):
        raise InputError(f"{file}: expected a list of results, or a dict with images, annotations, categories")
    table: dict[str, list[CocoResult]] = {}
    for index, record in enumerate(records):
        where = f"{file} [{index}]"
        if not isinstance(record, dict):
            raise InputError(
                f"{where}: expected a result with image_id, category_id, bbox, score, found {record!r:.60}"
            )
        kind = kinds.get(record.get("category_id"))
        image = record.get("image_id")
        if isinstance(image, bool) or not isinstance(image, (str, int)):
            raise InputError(f"{where}: image_id must be a text or a number, found {image!r:.60}")
        if kind is not None:
            detection = Detection2D(_box(record.get("bbox"), where), kind, _score(record.get("score", 1.0), where))
            result = CocoResult(detection, record.get("segmentation"), where)
            table.setdefault(images.get(image, str(image)), []).append(result)
    return {name: tuple(sorted(found, key=lambda one: -one.detection.score)) for name, found in table.items()}


def _named(content: dict[str, Any], what: str, key: str, file: str) -> dict[Any, str]:
    entries = content.get(what)
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and isinstance(entry.get(key), str) and "id" in entry for entry in entries
    ):
        raise InputError(f"{file}: {what} must be a list of entries with id and {key}")
    return {entry["id"]: entry[key] for entry in entries}


def _box(value: Any, where: str) -> Box2D:
    is_box = isinstance(value, list) and len(value) == 4 and all(_is_number(number) for number in value)
    if not is_box or min(value[2:]) <= 0:
        raise InputError(f"{where}: bbox must be [x, y, width, height] in px, found {value!r:.80}")
    x, y, width, height = (float(number) for number in value)
    return x, y, x + width, y + height


def _score(value: Any, where: str) -> float:
    if not _is_number(value) or not 0 <= value <= 1:
        raise InputError(f"{where}: score must lie between 0 and 1, found {value!r:.60}")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _inside(found: Sequence[CocoResult], photo: Photo) -> list[Detection2D]:
    height, width = photo.image.shape[:2]
    inside = []
    for result in found:
        x0, y0, x1, y1 = result.detection.box2d
        box = (max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height)))
        if box[2] - box[0] >= 1 and box[3] - box[1] >= 1:
            inside.append(Detection2D(box, result.detection.type, result.detection.score))
    return inside


def _iou(a: Box2D, b: Box2D) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(width, 0.0) * max(height, 0.0)
    area = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return common / (area - common)


def _mask(result: CocoResult, shape: tuple[int, ...]) -> Bool[np.ndarray, "height width"]:
    height, width = shape
    value = result.segmentation
    if isinstance(value, list) and value and all(isinstance(part, list) and len(part) >= 6 for part in value):
        mask = np.zeros((height, width), bool)
        for part in value:
            corners = np.array(part[: len(part) // 2 * 2], np.float64).reshape(-1, 2)
            mask |= polygon2mask((height, width), corners[:, ::-1] - 0.5)
        return mask
    mask = decode_rle(value, name=f"{result.where} segmentation")
    if mask.shape != (height, width):
        raise InputError(
            f"{result.where}: its mask must have the photograph's {width} x {height} pixels, it has {mask.shape[1]} x "
            f"{mask.shape[0]}"
        )
    return mask
