"""Where a box stands, as 4 x 4 matrices in float64, and what stands in its way.

`camera_from_car` is the box's pose; world is the log's; `standing` is the centre of the bottom face (y points down).
"""

import math
from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float

from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from carstudio.scene.graph import PlacedBox, Scene, SceneFrame, Vector3

Pose = Float[np.ndarray, "4 4"]
Point = Float[np.ndarray, "3"]


def pose_of(box: PlacedBox) -> Pose:
    """`camera_from_car` of a box."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(torch.tensor(box.rotation, dtype=torch.float64)).numpy()
    pose[:3, 3] = box.center
    return pose


def box_at(pose: Pose, size: Vector3) -> PlacedBox:
    """The box of that size at a `camera_from_car`."""
    quaternion = quaternion_from_rotation(torch.from_numpy(np.ascontiguousarray(pose[:3, :3])))
    return PlacedBox(_vector(pose[:3, 3]), size, _quaternion(quaternion))


def standing(box: PlacedBox) -> Point:
    """Centre of the box's bottom face in the camera frame, m."""
    pose = pose_of(box)
    result: Point = pose[:3, 3] + pose[:3, 1] * box.size[1] / 2
    return result


def box_standing(rotation: Float[np.ndarray, "3 3"], bottom: Point, size: Vector3) -> PlacedBox:
    """The box of that size whose bottom face has its centre at `bottom` (camera frame)."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = bottom - rotation[:, 1] * size[1] / 2
    return box_at(pose, size)


def turn_y(yaw_rad: float) -> Float[np.ndarray, "3 3"]:
    """KITTI's rotation about the y axis (down), as `geometry.transforms.rotation_y`."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def heading(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Yaw (rad) of a rotation's x axis in the x-z plane."""
    return math.atan2(-rotation[2, 0], rotation[0, 0])


def world_from_camera(frame: SceneFrame) -> Pose | None:
    """The frame's pose as an array; None where the log has none."""
    return None if frame.world_from_camera is None else np.array(frame.world_from_camera)


def ground_corners(box: PlacedBox) -> Float[np.ndarray, "4 2"]:
    """The box's outline seen from above: (x, z) of its corners in the camera frame, in order around it."""
    pose, (length, _, width) = pose_of(box), box.size
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    return (pose[:3, 3] + corners[:, :1] * pose[:3, 0] + corners[:, 1:] * pose[:3, 2])[:, [0, 2]]


def collide(a: PlacedBox, b: PlacedBox) -> bool:
    """Whether two boxes of one frame overlap, by the separating axes of their outlines and by height."""
    (ax, ay, az), (bx, by, bz) = a.center, b.center
    if abs(ay - by) * 2 >= a.size[1] + b.size[1]:
        return False
    reach = (math.hypot(a.size[0], a.size[2]) + math.hypot(b.size[0], b.size[2])) / 2
    if math.hypot(ax - bx, az - bz) >= reach:
        return False
    p, q = ground_corners(a), ground_corners(b)
    for corners in (p, q):
        for edge in (corners[1] - corners[0], corners[2] - corners[1]):
            normal = np.array([-edge[1], edge[0]])
            mine, theirs = p @ normal, q @ normal
            if mine.max() <= theirs.min() or theirs.max() <= mine.min():
                return False
    return True


def is_in_view(box: PlacedBox, frame: SceneFrame) -> bool:
    """Whether any of the box falls into the photograph."""
    one = box.box()
    single = Box3D(one.center[0], one.size[0], one.rotation[0])
    return envelope(single, frame.camera()) is not None


def posed_frames(scene: Scene) -> list[tuple[SceneFrame, Pose]]:
    """The frames that have a pose."""
    return [(frame, np.array(frame.world_from_camera)) for frame in scene.frames if frame.world_from_camera is not None]


def as_ranges(indices: Iterable[int]) -> str:
    """`3-7, 9`: frame numbers in a few words."""
    parts: list[list[int]] = []
    for index in sorted(set(indices)):
        if parts and index == parts[-1][-1] + 1:
            parts[-1].append(index)
        else:
            parts.append([index])
    return ", ".join(f"{part[0]}-{part[-1]}" if len(part) > 1 else str(part[0]) for part in parts)


def _vector(values: np.ndarray) -> Vector3:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _quaternion(values: torch.Tensor) -> tuple[float, float, float, float]:
    w, x, y, z = values.tolist()
    return w, x, y, z
