"""New labels for edited frames: boxes as they are placed, 2-D boxes from what is visible, occlusion, truncation."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt16

from carstudio.geometry.box3d import Box3D, projected_hull_points
from carstudio.geometry.camera import Camera
from carstudio.scene.footprint import outline_mask
from carstudio.scene.frame_jobs import PlacedObject
from carstudio.scene.graph import PlacedBox

Box2D = tuple[float, float, float, float]  # x0, y0, x1, y1 px: pixels 3..7 are 3.0 to 8.0
# Visible shares from which KITTI's levels "fully visible" and "partly occluded" are taken; below: "largely occluded".
FULLY, PARTLY = 0.9, 0.5
_CHANGED = 0.02  # hidden share of an untouched object above which its label is made anew


@dataclass(frozen=True, kw_only=True)
class ObjectTruth:
    """What is true of one object in one frame. `box2d` is None where nothing of it is seen."""

    track_id: str
    number: int
    type: str
    is_drawn: bool
    box: PlacedBox
    box2d: Box2D | None
    occlusion: int  # KITTI's levels: 0 fully visible, 1 partly, 2 largely occluded, 3 unknown
    occluded_share: float | None  # of its pixels in the frame; None: unknown (it has no silhouette)
    truncation: float  # share of its outline outside the frame, 0 to 1
    num_pixels: int | None  # visible ones; None: it has no silhouette


def truth_of(
    placed: PlacedObject,
    camera: Camera,
    instances: UInt16[np.ndarray, "height width"],
    alone: Float[np.ndarray, "height width"] | None,
    drawn: Bool[np.ndarray, "height width"],
) -> ObjectTruth:
    """Truth of an object. `alone` is its opacity if nothing stood before it, None where it has no car.

    `drawn` are pixels of drawn cars that may hide it.
    """
    if alone is not None:
        return _silhouette_truth(placed, camera, instances == placed.number, alone > 0.5, drawn)
    outline = outline_mask(placed.box, camera)
    hidden = float((outline & drawn).sum() / max(1, outline.sum()))
    box2d = _label_box(placed.label) or bounding_box(outline)
    if hidden > _CHANGED:
        box2d = _inner(box2d, bounding_box(outline & ~drawn))
    return _truth(placed, camera, box2d, None, hidden, None)


def _silhouette_truth(
    placed: PlacedObject,
    camera: Camera,
    visible: Bool[np.ndarray, "height width"],
    whole: Bool[np.ndarray, "height width"],
    drawn: Bool[np.ndarray, "height width"],
) -> ObjectTruth:
    count = int(whole.sum())
    occluded = 1 - int((visible & whole).sum()) / count if count else 1.0
    if placed.is_drawn:
        return _truth(placed, camera, bounding_box(visible), occluded, occluded, int(visible.sum()))
    hidden = int((whole & drawn & ~visible).sum()) / count if count else 0.0
    box2d = _label_box(placed.label) or bounding_box(visible)
    if hidden > _CHANGED:
        box2d = _inner(box2d, bounding_box(visible))
    return _truth(placed, camera, box2d, occluded, hidden, int(visible.sum()))


def _truth(
    placed: PlacedObject, camera: Camera, box2d: Box2D | None, share: float | None, hidden: float, pixels: int | None
) -> ObjectTruth:
    """`hidden` is the share that drawn cars hide; an untouched object's own label says what else hides it."""
    before = (placed.label or {}).get("occlusion")
    level = occlusion_level(1 - hidden)
    if not placed.is_drawn:
        known = int(before) if isinstance(before, (int, float)) and 0 <= before <= 3 else 3
        level = known if hidden <= _CHANGED else max(level, known if known < 3 else 0)
    return ObjectTruth(
        track_id=placed.track_id,
        number=placed.number,
        type=placed.type,
        is_drawn=placed.is_drawn,
        box=placed.box,
        box2d=box2d,
        occlusion=level,
        occluded_share=None if share is None else round(share, 4),
        truncation=round(truncation_of(placed.box, camera), 4),
        num_pixels=pixels,
    )


def occlusion_level(visible_share: float) -> int:
    """KITTI's level of a visible share."""
    if visible_share >= FULLY:
        return 0
    return 1 if visible_share >= PARTLY else 2


def bounding_box(mask: Bool[np.ndarray, "height width"]) -> Box2D | None:
    """The smallest box around the mask's pixels, whole pixels; None for an empty mask."""
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    if len(rows) == 0:
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def _label_box(label: dict[str, Any] | None) -> Box2D | None:
    value = (label or {}).get("box2d")
    if not isinstance(value, (list, tuple)) or len(value) != 4:
        return None
    x0, y0, x1, y1 = (float(number) for number in value)
    return x0, y0, x1, y1


def _inner(label: Box2D | None, seen: Box2D | None) -> Box2D | None:
    """What is left of a label's box; None when nothing is."""
    if label is None or seen is None:
        return seen
    x0, y0, x1, y1 = max(label[0], seen[0]), max(label[1], seen[1]), min(label[2], seen[2]), min(label[3], seen[3])
    return (x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None


def truncation_of(placed: PlacedBox, camera: Camera) -> float:
    """Share of the projected box's outline that lies outside the photograph, 0 to 1; 1 where none of it is in view."""
    box = placed.box()
    points = projected_hull_points(Box3D(box.center[0], box.size[0], box.rotation[0]), camera).numpy()
    if len(points) < 3:
        return 1.0
    hull = cv2.convexHull(points.clip(-1e6, 1e6).astype(np.float32))
    area = float(cv2.contourArea(hull))
    frame = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], np.float32)
    inside, _ = cv2.intersectConvexConvex(hull, frame[:, None])
    return min(1.0, max(0.0, 1 - float(inside) / area)) if area > 0 else 1.0


def label_line(truth: ObjectTruth, camera_offset: tuple[float, float, float]) -> str | None:
    """KITTI's 15 columns; None for an object that nobody can see. A tilted box is written by its heading alone."""
    if truth.box2d is None:
        return None
    box = truth.box.box()
    x, y, z = (float(c) - offset for c, offset in zip(box.center[0], camera_offset, strict=True))
    length, height, width = truth.box.size
    yaw = float(box.yaw_rad[0])
    alpha = math.remainder(yaw - math.atan2(x, z), 2 * math.pi)
    columns = [
        truth.type,
        f"{truth.truncation:.2f}",
        str(truth.occlusion),
        *(f"{value:.6f}" for value in (alpha, *truth.box2d, height, width, length, x, y + height / 2, z, yaw)),
    ]
    return " ".join(columns)


def truths_of(record: Mapping[str, Any]) -> list[ObjectTruth]:
    """The truths in a frame's record."""
    found = []
    for value in record["objects"]:
        box = PlacedBox(*(tuple(value["box"][key]) for key in ("center", "size", "rotation")))
        box2d = None if value["box2d"] is None else tuple(value["box2d"])
        found.append(ObjectTruth(**{**value, "box": box, "box2d": box2d}))
    return found
