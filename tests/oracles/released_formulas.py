"""The released code's geometry written out from its formulas in float64 numpy; knows nothing of carstudio.

`record` is an entry of the authors' json. t = (obj_x, obj_y - height / 2, obj_z), S = diag(2/l, 2/h, 2/w, 1),
canonical_from_opengl_camera = S [R^T | -R^T t] G with G = diag(1, -1, -1, 1).
"""

from typing import Any

import numpy as np


def canonical_from_opengl(record: dict[str, Any], offset: np.ndarray | None = None) -> np.ndarray:
    """4 x 4. `offset` moves the box (metres, KITTI camera); None as released."""
    c, s = np.cos(record["yaw"]), np.sin(record["yaw"])
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    t = np.array([record["obj_x"], record["obj_y"] - record["height"] / 2, record["obj_z"]], np.float64)
    t = t if offset is None else t + offset
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = rotation.T, -rotation.T @ t
    scale = np.diag([2 / record["length"], 2 / record["height"], 2 / record["width"], 1.0])
    return scale @ rigid @ np.diag([1.0, -1.0, -1.0, 1.0])


def canonical_rays(record: dict[str, Any], offset: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3) and directions (height, width, 3) of the patch's pixels; images of unit vectors."""
    u = np.arange(int(record["xmin"]), int(record["xmax"]) + 1) + 0.5
    v = np.arange(int(record["ymin"]), int(record["ymax"]) + 1) + 0.5
    u, v = np.meshgrid(u, v)
    x, y = (u - record["cx"]) / record["fl_x"], -(v - record["cy"]) / record["fl_y"]
    opengl = np.stack([x, y, -np.ones_like(x)], axis=-1)
    opengl /= np.linalg.norm(opengl, axis=-1, keepdims=True)
    transform = canonical_from_opengl(record, offset)
    return transform[:3, 3], opengl @ transform[:3, :3].T


def offset(record: dict[str, Any]) -> np.ndarray:
    """K^-1 P2[:, 3], solved by hand from the last row up."""
    z = record["cam_tz"]
    y = (record["cam_ty"] - record["cy"] * z) / record["fl_y"]
    x = (record["cam_tx"] - record["cx"] * z) / record["fl_x"]
    return np.array([x, y, z])


def envelope(record: dict[str, Any]) -> tuple[float, float, float, float]:
    """2-D box around the eight corners, projected with P2 whole."""
    c, s = np.cos(record["yaw"]), np.sin(record["yaw"])
    corners = []
    for i in range(8):
        x, z = (1 if i & 1 else -1) * record["length"] / 2, (1 if i & 2 else -1) * record["width"] / 2
        y = -record["height"] if i & 4 else 0.0
        point = np.array([c * x + s * z + record["obj_x"], y + record["obj_y"], -s * x + c * z + record["obj_z"]])
        q = np.array(
            [
                record["fl_x"] * point[0] + record["cx"] * point[2] + record["cam_tx"],
                record["fl_y"] * point[1] + record["cy"] * point[2] + record["cam_ty"],
                point[2] + record["cam_tz"],
            ]
        )
        corners.append(q[:2] / q[2])
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
