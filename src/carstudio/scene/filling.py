"""What a car that was taken out had hidden: from other frames that see it, where that is sound, else inpainted.

A pixel's background point (ground, or LiDAR's depth) is looked up in frames whose poses are known and in which no
object stands before it. A frame is believed only if it also reproduces the ring of pixels around the hole, which are
known: so wrong poses, depths and moving things cost a worse fill, not a wrong one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from carstudio.geometry.camera import Camera
from carstudio.scene.footprint import any_of, grown, outline_mask
from carstudio.scene.frame_jobs import Neighbour
from carstudio.scene.graph import SceneFrame
from carstudio.scene.ground import unproject_pixels

SKY_M = 1e4  # depth that stands for "as far as can be": only the camera's turning moves it
_MOST_FRAMES = 4  # one hole is filled from
_LEAST_SHARE = 0.03  # of the hole that a further frame must show
_RING_PX = 8
_WRONG = 14.0  # median difference (8-bit steps, exposure matched) of the ring above which a frame is not believed
_CLEAR_PX = 6  # from objects' outlines in the other frame: their shadows, and boxes are not exact
_INPAINT_RADIUS_PX = 4
_AROUND_PX = 24  # of known pixels that inpainting goes by
_LEAST_KNOWN = 50  # pixels of the same surface; with fewer any known pixel counts
_COARSE_FROM_PX = 8000.0
_KNOWN_SHARE = 0.3  # of a coarse pixel

Photograph = UInt8[np.ndarray, "height width 3"]


@runtime_checkable
class Inpainter(Protocol):
    """Makes up pixels from their surroundings; the place for a learned one."""

    def inpaint(self, image: Photograph, hole: Bool[np.ndarray, "height width"]) -> Photograph:
        """The image with plausible pixels in the hole."""


@dataclass(frozen=True)
class OpenCvInpainter:
    """Telea, "An Image Inpainting Technique Based on the Fast Marching Method" (2004)."""

    radius_px: int = _INPAINT_RADIUS_PX

    def inpaint(self, image: Photograph, hole: Bool[np.ndarray, "height width"]) -> Photograph:
        """Hole pixels grow inward from the rim."""
        return np.asarray(cv2.inpaint(image, hole.astype(np.uint8), self.radius_px, cv2.INPAINT_TELEA))


@dataclass(frozen=True)
class Filled:
    """The photograph without the cars, and which of the hole's pixels other frames have shown."""

    image: Photograph
    is_seen: Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class _Points:
    """Background points of pixels: row, column, position in the world (m)."""

    rows: np.ndarray
    columns: np.ndarray
    world: Float[np.ndarray, "n 3"]


def fill_hole(
    image: Photograph,
    hole: Bool[np.ndarray, "height width"],
    *,
    avoid: Bool[np.ndarray, "height width"],
    on_ground: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    frame: SceneFrame,
    neighbours: Sequence[Neighbour],
    read: Callable[[SceneFrame], Photograph],
    inpainter: Inpainter | None = None,
) -> Filled:
    """Fill `hole` and nothing else. `avoid` are other objects of the photograph: no background to go by.

    `on_ground` are pixels whose background is the ground.
    """
    filled, missing = image.copy(), hole.copy()
    if not hole.any():
        return Filled(filled, missing)
    if frame.world_from_camera is not None and neighbours:
        _from_frames(filled, missing, grown(hole, _RING_PX) & ~hole & ~avoid, depth_m, frame, neighbours, read)
    is_seen = hole & ~missing
    for surface in (on_ground, ~on_ground):
        _paint(filled, missing & surface, surface & ~missing & ~avoid, inpainter or OpenCvInpainter())
    return Filled(filled, is_seen)


def _paint(
    filled: Photograph,
    part: Bool[np.ndarray, "height width"],
    known: Bool[np.ndarray, "height width"],
    inpainter: Inpainter,
) -> None:
    """Inpaint a part of the hole from known pixels of its own surface: walls do not run into the road.

    What is large is made up at a coarser scale: it is smooth anyway, and Telea's method would take seconds.
    """
    if not part.any():
        return
    top, bottom, left, right = _window(part, _AROUND_PX)
    inside = (slice(top, bottom), slice(left, right))
    image, wanted, source = filled[inside], part[inside], known[inside]
    if source.sum() < _LEAST_KNOWN:
        source = ~wanted
    scale = max(1, round((float((~source).sum()) / _COARSE_FROM_PX) ** 0.5))
    size = (max(1, image.shape[1] // scale), max(1, image.shape[0] // scale))
    weight = np.asarray(cv2.resize(source.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    light = np.asarray(cv2.resize(image * source[..., None].astype(np.float32), size, interpolation=cv2.INTER_AREA))
    coarse = np.clip(np.round(light / np.maximum(weight, 1e-3)[..., None]), 0, 255).astype(np.uint8)
    painted = inpainter.inpaint(coarse, weight < _KNOWN_SHARE)
    full = np.asarray(cv2.resize(painted, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR))
    image[wanted] = full[wanted]


def _window(mask: Bool[np.ndarray, "height width"], margin: int) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    height, width = mask.shape
    return (
        max(0, int(rows[0]) - margin),
        min(height, int(rows[-1]) + 1 + margin),
        max(0, int(columns[0]) - margin),
        min(width, int(columns[-1]) + 1 + margin),
    )


def _from_frames(
    filled: Photograph,
    missing: Bool[np.ndarray, "height width"],
    ring: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    frame: SceneFrame,
    neighbours: Sequence[Neighbour],
    read: Callable[[SceneFrame], Photograph],
) -> None:
    """Fill from the frames that show most of what is missing, one after the other; `filled`, `missing` are changed."""
    wanted, around = _points(missing, depth_m, frame), _points(ring, depth_m, frame)
    left = np.ones(len(wanted.rows), bool)
    places = [_places(wanted.world, other) for other in neighbours]
    untried = set(range(len(neighbours)))
    for _ in range(_MOST_FRAMES):
        if not untried:
            return
        best = max(sorted(untried), key=lambda i: int((places[i][1] & left).sum()))
        untried.remove(best)
        positions, is_shown = places[best]
        if (is_shown & left).sum() < max(1, _LEAST_SHARE * len(left)):
            return
        photo = read(neighbours[best].frame)
        gain = _agreement(photo, filled, around, neighbours[best])
        if gain is None:
            continue
        taken = is_shown & left
        colours = sampled_colours(photo, positions[taken]) * gain
        filled[wanted.rows[taken], wanted.columns[taken]] = np.clip(np.round(colours), 0, 255).astype(np.uint8)
        missing[wanted.rows[taken], wanted.columns[taken]] = False
        left &= ~taken


def _points(
    mask: Bool[np.ndarray, "height width"], depth_m: Float[np.ndarray, "height width"], frame: SceneFrame
) -> _Points:
    rows, columns = np.nonzero(mask)
    depth = depth_m[rows, columns]
    points = unproject_pixels(frame.camera(), rows, columns, np.where(np.isfinite(depth), depth, SKY_M))
    pose = np.array(frame.world_from_camera, np.float64)
    return _Points(rows, columns, points @ pose[:3, :3].T + pose[:3, 3])


def _places(world: Float[np.ndarray, "n 3"], other: Neighbour) -> tuple[np.ndarray, np.ndarray]:
    """Positions (px) in another frame, and whether it shows the point: in view, and no object near it."""
    pose = np.linalg.inv(np.array(other.frame.world_from_camera, np.float64))
    points = world @ pose[:3, :3].T + pose[:3, 3]
    camera = other.frame.camera()
    wide = Camera(camera.intrinsics.double(), camera.width, camera.height)
    ahead = points[:, 2] > 0.5
    safe = np.where(ahead[:, None], points, np.array([0.0, 0.0, 1.0]))
    positions = wide.project(torch.from_numpy(safe)).numpy()
    x, y = positions.T
    inside = ahead & (x >= 1) & (y >= 1) & (x <= camera.width - 1) & (y <= camera.height - 1)
    objects = grown(any_of((outline_mask(box, camera) for box in other.boxes), camera), _CLEAR_PX)
    column, row = (np.clip(v, 0, limit - 1).astype(int) for v, limit in ((x, camera.width), (y, camera.height)))
    return positions, inside & ~objects[row, column]


def _agreement(
    photo: Photograph, image: Photograph, around: _Points, other: Neighbour
) -> Float[np.ndarray, "3"] | None:
    """Gain per channel that turns the other frame's ring into this one's; None when they do not agree."""
    positions, is_shown = _places(around.world, other)
    if is_shown.sum() < 30:
        return None
    theirs = sampled_colours(photo, positions[is_shown])
    ours = image[around.rows[is_shown], around.columns[is_shown]].astype(np.float64)
    gain = np.clip(np.median(ours, axis=0) / np.maximum(np.median(theirs, axis=0), 1.0), 0.8, 1.25)
    wrong = float(np.median(np.abs(theirs * gain - ours).mean(axis=1)))
    return np.asarray(gain) if wrong <= _WRONG else None


def sampled_colours(photo: Photograph, positions: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Colours between pixel centres (which lie at +0.5), bilinear."""
    x, y = (positions - 0.5).astype(np.float32).T
    # remap takes pictures with sides below 32,768: the points are laid out in rows
    width = 1024
    pad = -len(x) % width
    grid = [np.pad(v, (0, pad)).reshape(-1, width) for v in (x, y)]
    colours = cv2.remap(photo, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours).reshape(-1, 3)[: len(x)].astype(np.float64)
