"""Where the camera was: KITTI odometry poses, else the OXTS (GPS and IMU) record, else nothing.

World is what the file says: the first camera of a pose file (x right, y down, z forward), the first frame's camera for
OXTS. Metres.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from carstudio.dataset.sources.kitti_format import read_text
from carstudio.errors import InputError
from carstudio.scene.graph import Matrix, Vector3

Pose = Float[np.ndarray, "4 4"]
_EARTH_RADIUS_M = 6378137.0  # WGS-84's equator, as in KITTI's development kit
_RIGID = 1e-3  # pose files have nine digits
_OXTS_COLUMNS = 6  # lat lon alt roll pitch yaw, then what is not needed here


def read_odometry_poses(path: Path, camera_offset: Vector3) -> dict[int, Matrix]:
    """`world_from_camera` by frame number of a file with one 3 x 4 matrix a line (line 1 is frame 0).

    The file places the label frame (KITTI's camera 0); the photographs' camera lies at -`camera_offset` in it.
    """
    poses = {}
    for number, line in enumerate(read_text(path, "poses").split("\n")):
        if not line.strip():
            continue
        values = _numbers(line, 12, f"{path} line {number + 1}")
        pose = np.vstack([np.array(values).reshape(3, 4), [0, 0, 0, 1]])
        if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > _RIGID or np.linalg.det(pose[:3, :3]) < 0:
            raise InputError(f"{path} line {number + 1}: the first three columns must be a rotation; check the file")
        poses[number] = to_matrix(pose @ translation(tuple(-value for value in camera_offset)))
    return poses


def read_oxts_poses(path: Path, camera_from_imu: Pose) -> dict[int, Matrix]:
    """`world_from_camera` by frame number of an OXTS file (a frame per line); the first frame's camera is the world.

    Mercator projection at the first latitude, as in KITTI's development kit.
    """
    poses: dict[int, Pose] = {}
    scale = None
    for number, line in enumerate(read_text(path, "oxts").split("\n")):
        if not line.strip():
            continue
        latitude, longitude, altitude, roll, pitch, yaw = _numbers(
            line, _OXTS_COLUMNS, f"{path} line {number + 1}", more=True
        )
        scale = math.cos(math.radians(latitude)) if scale is None else scale
        east = scale * _EARTH_RADIUS_M * math.radians(longitude)
        north = scale * _EARTH_RADIUS_M * math.log(math.tan(math.pi * (90 + latitude) / 360))
        pose = np.eye(4)
        pose[:3, :3] = _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)
        pose[:3, 3] = east, north, altitude
        poses[number] = pose @ np.linalg.inv(camera_from_imu)
    if not poses:
        return {}
    camera_from_world = np.linalg.inv(poses[min(poses)])
    return {number: to_matrix(camera_from_world @ pose) for number, pose in poses.items()}


def read_transform(text: str, names: tuple[str, ...], *, name: str) -> Pose | None:
    """The 3 x 3 or 3 x 4 matrix of a calibration file under one of `names`, as 4 x 4; None when it is not there."""
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].rstrip(":") in names:
            count = 9 if len(words[1].split()) == 9 else 12
            values = np.array(_numbers(words[1], count, f"{name} line {number}")).reshape(3, -1)
            result = np.eye(4)
            result[:3, : values.shape[1]] = values
            return result
    return None


def lidar_and_imu(text: str, camera_offset: Vector3, *, name: str) -> Mapping[str, Pose]:
    """`camera_from_lidar` and `camera_from_imu`, those that a calibration file has (tracking or detection names)."""
    rectify = read_transform(text, ("R_rect", "R0_rect"), name=name)
    lidar = read_transform(text, ("Tr_velo_cam", "Tr_velo_to_cam"), name=name)
    imu = read_transform(text, ("Tr_imu_velo", "Tr_imu_to_velo"), name=name)
    if rectify is None or lidar is None:
        return {}
    camera_from_lidar = translation(camera_offset) @ rectify @ lidar
    found = {"camera_from_lidar": camera_from_lidar}
    return found if imu is None else {**found, "camera_from_imu": camera_from_lidar @ imu}


def translation(offset: tuple[float, ...]) -> Pose:
    """A pure translation."""
    result = np.eye(4)
    result[:3, 3] = offset
    return result


def to_matrix(pose: Pose) -> Matrix:
    """A 4 x 4 array as the scene keeps it."""
    return tuple(tuple(float(value) for value in row) for row in pose)


def _numbers(line: str, count: int, where: str, *, more: bool = False) -> list[float]:
    words = line.split()
    if len(words) < count or (len(words) > count and not more):
        raise InputError(f"{where}: expected {count} numbers, found {len(words)}")
    try:
        values = [float(word) for word in words[:count]]
    except ValueError as error:
        raise InputError(f"{where}: expected {count} numbers, found {line[:60]!r}") from error
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"{where}: numbers must be finite")
    return values


def _turn(axis: int, angle_rad: float) -> Float[np.ndarray, "3 3"]:
    """A right-handed rotation about the x, y or z axis."""
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = math.cos(angle_rad)
    turn[j, i] = math.sin(angle_rad)
    turn[i, j] = -turn[j, i]
    return turn
