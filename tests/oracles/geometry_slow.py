"""Geometry written out slowly in float64 numpy: loops, faces and samples instead of closed forms."""

from itertools import product

import numpy as np


def rotation_y(yaw_rad: float) -> np.ndarray:
    """[[c, 0, s], [0, 1, 0], [-s, 0, c]], as the authors' release defines its yaw."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def canonical_from_opengl_camera(bottom_center, size, yaw_rad: float) -> np.ndarray:
    """S [R^T | -R^T t] G with t the centre of the box: the release's chain, size (length, height, width)."""
    length, height, width = size
    t = np.array([bottom_center[0], bottom_center[1] - height / 2, bottom_center[2]])
    rotation = rotation_y(yaw_rad)
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ t
    return np.diag([2 / length, 2 / height, 2 / width, 1.0]) @ inverse @ np.diag([1.0, -1.0, -1.0, 1.0])


def kitti_corners(bottom_center, size, yaw_rad: float) -> np.ndarray:
    """The eight corners of a label in its frame: four on the ground at y, four a height above, turned by the yaw."""
    length, height, width = size
    corners = []
    for forward, up, left in product((-length / 2, length / 2), (height, 0.0), (-width / 2, width / 2)):
        corners.append(rotation_y(yaw_rad) @ np.array([forward, -up, left]) + np.asarray(bottom_center))
    return np.array(corners)


def project(points: np.ndarray, intrinsics) -> np.ndarray:
    """Image positions by the 3 x 3 camera matrix, one point at a time."""
    fx, fy, cx, cy = intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    homogeneous = [matrix @ point for point in points]
    return np.array([h[:2] / h[2] for h in homogeneous])


def surface_points(size, rotation: np.ndarray, center, per_side: int = 60) -> np.ndarray:
    """A grid on the six faces of a box, edges and corners included, in the camera frame."""
    steps = np.linspace(-0.5, 0.5, per_side)
    points = []
    for axis, side in product(range(3), (-0.5, 0.5)):
        for a, b in product(steps, steps):
            point = np.empty(3)
            point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3] = side, a, b
            points.append(rotation @ (point * np.asarray(size)) + np.asarray(center))
    return np.array(points)


def ray_cube_interval(origin, direction, eps: float = 1e-9) -> tuple[float, float] | None:
    """Where a ray enters and leaves [-1, 1]^3: it is met with each of the six face planes in turn; None for a miss."""
    meets = [0.0] if np.all(np.abs(origin) <= 1 + eps) else []
    for axis, side in product(range(3), (-1.0, 1.0)):
        if direction[axis] == 0:
            continue
        t = (side - origin[axis]) / direction[axis]
        point = origin + t * direction
        others = [point[i] for i in range(3) if i != axis]
        if t > 0 and all(abs(value) <= 1 + eps for value in others):
            meets.append(t)
    return (min(meets), max(meets)) if meets and max(meets) > min(meets) else None


def rasterised_iou(a, b, extent: int) -> float:
    """IoU of two boxes with integer corners by counting the unit cells of an extent x extent grid."""
    common = union = 0
    for x, y in product(range(extent), range(extent)):
        in_a = a[0] <= x < a[2] and a[1] <= y < a[3]
        in_b = b[0] <= x < b[2] and b[1] <= y < b[3]
        common += in_a and in_b
        union += in_a or in_b
    return common / union if union else 0.0
