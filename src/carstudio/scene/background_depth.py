"""Depth of everything that is no drawn car, for each pixel: LiDAR, a network, the ground; inf where nothing is known.

LiDAR is thickened from near to far as in Ku et al., "In Defense of Classical Image Processing" (CRV 2018): small
dilations of the inverse depth, so that thin near things stay before what is behind them.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from carstudio.geometry.camera import Camera
from carstudio.scene.footprint import outline_mask
from carstudio.scene.graph import PlacedBox
from carstudio.scene.ground import Ground, unproject_pixels
from carstudio.scene.lidar import sparse_depth

FARTHEST_M = 120.0
_GROUND_NEAR_M, _GROUND_PER_M = 0.25, 0.02  # what is lower than this above the plane is ground: camber, kerbs, noise
_SLACK, _SLACK_M = 0.03, 0.2
_SINK_M = 0.2  # the ground lets wheels in this far before it hides them: no plane is that exact
_UNKNOWN = np.float32(1e6)
_DIAMOND = np.array([[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]], np.uint8)


def densified(sparse: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Depth between LiDAR's points, inf where no point is near (about 12 px)."""
    known = np.isfinite(sparse) & (sparse < FARTHEST_M)
    nearness = np.asarray(np.where(known, 1 / np.maximum(sparse, 0.1), 0.0), np.float32)
    nearness = np.asarray(cv2.dilate(nearness, _DIAMOND))
    nearness = np.asarray(cv2.morphologyEx(nearness, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)))
    for side in (7, 15, 25):  # wider gaps take the farthest of what is around them: a guess must not hide cars
        wider = cv2.erode(np.where(nearness > 0, nearness, _UNKNOWN), np.ones((side, side), np.uint8))
        nearness = np.where((nearness > 0) | (wider >= _UNKNOWN), nearness, wider)
    smooth = cv2.medianBlur(nearness, 5)
    nearness = np.where((nearness > 0) & (smooth > 0), smooth, nearness)
    with np.errstate(divide="ignore"):
        return np.where(nearness > 0, 1 / nearness, np.inf).astype(np.float64)


def background_depth(
    camera: Camera,
    ground: Ground,
    *,
    points: Float[np.ndarray, "n 3"] | None,
    network: Float[np.ndarray, "height width"] | None,
    solid: Sequence[PlacedBox],
    gone: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Depth (m) of the photograph without the cars that are drawn or `gone`; inf: nothing known, as far as the sky.

    LiDAR where its points are near, else the network's depth (already metric, see `align_depth`), else the ground.
    `solid` are objects of the photograph that nothing better is known of than their boxes. Where a car has gone, the
    network has seen that car: there the ground counts instead.
    """
    plane = ground.depth(camera)
    floor = np.where((plane > 0) & (plane < FARTHEST_M), plane, np.inf)
    depth = np.full(floor.shape, np.inf)
    if points is not None:
        depth = densified(sparse_depth(points, camera))
    if network is not None:
        depth = np.where(np.isfinite(depth) | gone, depth, network)
    depth = np.where(np.isfinite(depth), depth, floor)
    if points is None:
        for box in solid:
            depth = np.where(outline_mask(box, camera), np.minimum(depth, _front_m(box)), depth)
    return depth


def _front_m(box: PlacedBox) -> float:
    """Depth that stands for the whole of an object: its nearest corner's, but not behind the camera."""
    return max(0.5, float(box.box().corners()[0, :, 2].min()))


def is_ground(
    depth_m: Float[np.ndarray, "height width"], ground: Ground, camera: Camera
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose depth puts them on the plane, or so little above it that a car would stand on them."""
    seen = np.isfinite(depth_m)
    above = np.full(depth_m.shape, np.inf)
    rows, columns = np.nonzero(seen)
    above[rows, columns] = ground.height_of(unproject_pixels(camera, rows, columns, depth_m[rows, columns]))
    return np.asarray(above < _GROUND_NEAR_M + _GROUND_PER_M * np.where(seen, depth_m, 0.0)) & (ground.fall(camera) > 0)


def hiding_depth(
    depth_m: Float[np.ndarray, "height width"], ground: Ground, camera: Camera
) -> Float[np.ndarray, "height width"]:
    """Depth behind which the background hides cars: the background's, but ground hides only what is under it.

    Elsewhere too a little behind it is still before it: depths and boxes are not exact, and a pole that wrongly stands
    before a car's bumper is seen at once.
    """
    sunk = ground.depth(camera, lower_m=_SINK_M)
    slack = depth_m * (1 + _SLACK) + _SLACK_M
    return np.where(is_ground(depth_m, ground, camera), np.maximum(slack, sunk), slack)


def align_depth(
    inverse_depth: Float[np.ndarray, "height width"], known_m: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Metric depth from a network's inverse depth of unknown scale and shift: the line through the known depths.

    `known_m` is inf where nothing is known (LiDAR, or the ground). Iteratively reweighted least squares in inverse
    depth, so that near things, which hide, count more. All inf with fewer than 50 known pixels or a line that falls.
    """
    rows, columns = np.nonzero(np.isfinite(known_m) & np.isfinite(inverse_depth))
    result = np.full(inverse_depth.shape, np.inf)
    if len(rows) < 50:
        return result
    x, y = inverse_depth[rows, columns].astype(np.float64), 1 / known_m[rows, columns]
    weight = np.ones_like(x)
    scale = shift = 0.0
    for _ in range(10):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = np.average((x - mean_x) ** 2, weights=weight)
        scale = float(np.average((x - mean_x) * (y - mean_y), weights=weight) / max(spread, 1e-12))
        shift = float(mean_y - scale * mean_x)
        error = np.abs(scale * x + shift - y)
        weight = 1 / np.maximum(error, 1e-3 + float(np.median(error)))
    if scale <= 0:
        return result
    nearness = scale * inverse_depth + shift
    return np.where(nearness > 1 / FARTHEST_M, 1 / np.maximum(nearness, 1e-6), np.inf)
