"""Which pixels of a photograph a box may cover: its outline, and the ground around it where its shadow falls."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from carstudio.geometry.box3d import Box3D, projected_hull_points
from carstudio.geometry.camera import Camera
from carstudio.scene.graph import PlacedBox
from carstudio.scene.ground import Ground, bottom_center

_FINE = 4  # bits below the pixel of OpenCV's fixed-point positions
_FAR_PX = 1e6  # OpenCV's fixed-point positions are 32 bit; nothing that far matters
CAR_HEIGHT_M = 1.85  # higher boxes are vans and trucks
# Corners (canonical: x front, y down, z left) of what a passenger car fills: up to the sills of its windows all of the
# box; above them not the bonnet, and less at the sides. Estates and hatchbacks fill the box up to the roof's rear end.
BODY = ((-1.0, -0.2, -1.0), (1.0, 1.0, 1.0))
ROOF = ((-0.95, -1.0, -0.85), (0.5, -0.2, 0.85))
SHADOW_REACH_M = 0.6  # beside the box: where a contact shadow ends (three of its softest standard deviations)


def outline_mask(placed: PlacedBox, camera: Camera, *, grow_px: int = 0) -> Bool[np.ndarray, "height width"]:
    """Pixels that the convex outline of the projected box touches, and `grow_px` around it."""
    return _fill((_single(placed),), camera, grow_px)


def body_mask(placed: PlacedBox, camera: Camera, *, grow_px: int = 0) -> Bool[np.ndarray, "height width"]:
    """Pixels that a vehicle which fills this box may cover: of a passenger car less than the box at its roof.

    The outline of two boxes, the body and a roof drawn in from the bonnet and the sides; of anything higher than
    a passenger car the whole box.
    """
    if placed.size[1] > CAR_HEIGHT_M:
        return outline_mask(placed, camera, grow_px=grow_px)
    box = placed.box()
    parts = []
    for low, high in BODY, ROOF:
        middle, share = (torch.tensor(low) + torch.tensor(high)) / 2, (torch.tensor(high) - torch.tensor(low)) / 2
        center = box.center[0] + box.rotation[0] @ (middle * box.size[0] / 2)
        parts.append(Box3D(center, box.size[0] * share, box.rotation[0]))
    return _fill(tuple(parts), camera, grow_px)


def _single(placed: PlacedBox) -> Box3D:
    box = placed.box()
    return Box3D(box.center[0], box.size[0], box.rotation[0])


def _fill(boxes: tuple[Box3D, ...], camera: Camera, grow_px: int) -> Bool[np.ndarray, "height width"]:
    mask = np.zeros((camera.height, camera.width), np.uint8)
    points = np.concatenate([projected_hull_points(box, camera).double().numpy() for box in boxes])
    if len(points) == 0:
        return mask.astype(bool)
    fixed = np.round((points - 0.5).clip(-_FAR_PX, _FAR_PX) * 2**_FINE).astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(fixed), 1, cv2.LINE_8, _FINE)
    return grown(mask.astype(bool), grow_px) if grow_px else mask.astype(bool)


def grown(mask: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    """The mask and all pixels up to `by_px` beside it (a square)."""
    side = 2 * by_px + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)


def ground_mask(
    placed: PlacedBox, ground: Ground, camera: Camera, *, reach_m: float = SHADOW_REACH_M
) -> Bool[np.ndarray, "height width"]:
    """Pixels of the ground under the box and up to `reach_m` beside it."""
    return flat_mask(ground_rectangle(placed, ground).grown(reach_m), camera)


@dataclass(frozen=True)
class GroundRectangle:
    """The box's bottom face let down onto the ground: centre, unit axes (along, across), half sizes, m; and the gap."""

    center: Float[np.ndarray, "3"]
    along: Float[np.ndarray, "3"]
    across: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    half_m: tuple[float, float]
    gap_m: float  # height of the bottom above the ground

    def grown(self, by_m: float) -> "GroundRectangle":
        """A larger rectangle with the same centre."""
        half = (self.half_m[0] + by_m, self.half_m[1] + by_m)
        return GroundRectangle(self.center, self.along, self.across, self.normal, half, self.gap_m)

    def flat_box(self) -> Box3D:
        """As a box a centimetre high."""
        rotation = np.stack([self.along, self.normal, self.across], axis=1)
        size = [2 * self.half_m[0], 0.01, 2 * self.half_m[1]]
        return Box3D(torch.from_numpy(self.center).float(), torch.tensor(size), torch.from_numpy(rotation).float())


def ground_rectangle(placed: PlacedBox, ground: Ground) -> GroundRectangle:
    """Where the box stands."""
    normal = np.array(ground.normal)
    bottom = bottom_center(placed)
    gap = float(ground.height_of(bottom))
    forward = placed.box().rotation[0, :, 0].double().numpy()
    along = forward - (forward @ normal) * normal
    norm = np.linalg.norm(along)
    along = along / norm if norm > 1e-6 else np.array([0.0, -normal[2], normal[1]]) / np.hypot(normal[1], normal[2])
    half = (placed.size[0] / 2, placed.size[2] / 2)
    return GroundRectangle(bottom + gap * normal, along, np.cross(along, normal), normal, half, gap)


def flat_mask(rectangle: GroundRectangle, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels of a rectangle on the ground, and one pixel around them."""
    return _fill((rectangle.flat_box(),), camera, 1)


def any_of(masks: Iterable[Bool[np.ndarray, "height width"]], camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels of any of the masks; none when there are none."""
    result = np.zeros((camera.height, camera.width), bool)
    for mask in masks:
        result |= mask
    return result
