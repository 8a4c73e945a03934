"""The ground as a plane in a frame's camera: from LiDAR, else from where boxes stand, else from the camera's height.

A point X (camera frame, m) lies on the plane n . X = h, with n the unit vector that points down and h the camera's
height above the plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from carstudio.geometry.camera import Camera
from carstudio.scene.graph import PlacedBox, Vector3
from carstudio.scene.terrain import CAMERA_HEIGHT_M

_STEEPEST = 0.2  # sine of the angle to the camera's y axis: 11 degrees, more than any road and any mounting
_NEAR_ENOUGH_M = 0.1  # of a plane: LiDAR's noise and the road's camber
_TRIES = 200
_LEAST_POINTS = 200
# Boxes: how far bottoms lie off the road (m), and how far roads are from level (slope) where boxes cannot tell.
_BOTTOM_NOISE_M, _SLOPE = 0.1, 0.02


@dataclass(frozen=True)
class Ground:
    """The plane normal . X = height_m, and what it was found from ("lidar", "boxes" or "camera height")."""

    normal: Vector3
    height_m: float
    source: str

    def height_of(self, points: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
        """Metres above the plane; negative below it."""
        return np.asarray(self.height_m - points @ np.array(self.normal))

    def depth(self, camera: Camera, *, lower_m: float = 0.0) -> Float[np.ndarray, "height width"]:
        """Depth (camera z, m) at which pixels' rays meet the plane, moved down by `lower_m`; inf above the horizon."""
        fall = self.fall(camera)
        with np.errstate(divide="ignore"):
            return np.where(fall > 0, (self.height_m + lower_m) / np.where(fall > 0, fall, 1.0), np.inf)

    def fall(self, camera: Camera) -> Float[np.ndarray, "height width"]:
        """How far each pixel's ray comes down per metre of depth."""
        fx, fy, cx, cy = (float(value) for value in camera.intrinsics)
        x = (np.arange(camera.width) + 0.5 - cx) / fx
        y = (np.arange(camera.height) + 0.5 - cy) / fy
        return (self.normal[0] * x[None] + self.normal[1] * y[:, None] + self.normal[2]).astype(np.float64)


def find_ground(points: Float[np.ndarray, "n 3"] | None, boxes: Sequence[PlacedBox]) -> Ground:
    """The best plane there is evidence for."""
    ground = ground_from_points(points) if points is not None else None
    if ground is None and boxes:
        ground = ground_from_boxes(boxes)
    return ground or Ground((0.0, 1.0, 0.0), CAMERA_HEIGHT_M, "camera height")


def ground_from_points(points: Float[np.ndarray, "n 3"]) -> Ground | None:
    """The plane most points before the camera lie on (RANSAC, Fischler and Bolles 1981); None when there is none.

    Looks where roads are: up to 12 m to the sides, 3 to 40 m ahead, below the camera. The same points give the same
    plane.
    """
    x, y, z = points.T
    near = points[(np.abs(x) < 12) & (z > 3) & (z < 40) & (y > 0.3)].astype(np.float64)
    if len(near) < _LEAST_POINTS:
        return None
    random = np.random.default_rng(0)
    tried = near[random.permutation(len(near))[:4000]]
    best, most = None, 0
    for corners in tried[random.integers(0, len(tried), (_TRIES, 3))]:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        length = np.linalg.norm(normal)
        if length < 1e-6 or abs(normal[1]) / length < (1 - _STEEPEST**2) ** 0.5:
            continue
        normal = normal / length * np.sign(normal[1])
        count = int((np.abs(tried @ normal - corners[0] @ normal) < _NEAR_ENOUGH_M).sum())
        if count > most:
            best, most = (normal, float(corners[0] @ normal)), count
    if best is None or most < len(tried) / 10:
        return None
    inliers = near[np.abs(near @ best[0] - best[1]) < _NEAR_ENOUGH_M]
    center = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - center, full_matrices=False)[2][2]
    normal = normal * np.sign(normal[1])
    return _ground(normal, float(center @ normal), "lidar")


def ground_from_boxes(boxes: Sequence[PlacedBox]) -> Ground:
    """The plane under the boxes' bottoms, as level as they allow (robust ridge regression of y on x and z)."""
    bottoms = np.array([bottom_center(box) for box in boxes], np.float64)
    x, y, z = bottoms.T
    middle = np.array([x.mean(), 0.0, z.mean()])
    design = np.stack([x - middle[0], z - middle[2], np.ones_like(x)], axis=1)
    ridge = np.diag([(_BOTTOM_NOISE_M / _SLOPE) ** 2] * 2 + [0.0])
    weight = np.ones_like(y)
    slopes = np.zeros(3)
    for _ in range(3):
        slopes = np.linalg.solve(design.T @ (weight[:, None] * design) + ridge, design.T @ (weight * y))
        weight = 1 / np.maximum(1.0, np.abs(design @ slopes - y) / _BOTTOM_NOISE_M)
    a, b, c = slopes
    normal = np.array([-a, 1.0, -b]) / np.sqrt(1 + a * a + b * b)
    return _ground(normal, float(normal @ np.array([middle[0], c, middle[2]])), "boxes")


def _ground(normal: Float[np.ndarray, "3"], height_m: float, source: str) -> Ground:
    x, y, z = (float(value) for value in normal)
    return Ground((x, y, z), height_m, source)


def bottom_center(placed: PlacedBox) -> Float[np.ndarray, "3"]:
    """Centre of the box's bottom face, camera frame, m."""
    box = placed.box()
    down = box.rotation[0, :, 1] * box.size[0, 1] / 2
    bottom: Float[np.ndarray, "3"] = (box.center[0] + down).double().numpy()
    return bottom


def unproject_pixels(
    camera: Camera, rows: np.ndarray, columns: np.ndarray, depth_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Points (camera frame, m) behind the centres of pixels."""
    positions = torch.from_numpy(np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float64))
    wide = Camera(camera.intrinsics.double(), camera.width, camera.height)
    points: Float[np.ndarray, "n 3"] = wide.unproject(positions, torch.from_numpy(depth_m.astype(np.float64))).numpy()
    return points
