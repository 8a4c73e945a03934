"""Where the poses of an edit put a car: from places in camera, world or path coordinates to a box per frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from carstudio.errors import InputError
from carstudio.scene.edits import AxesName, Place
from carstudio.scene.graph import PlacedBox, Scene, SceneFrame, Vector3
from carstudio.scene.path import EgoPath, ego_path
from carstudio.scene.places import Pose, box_standing, heading, pose_of, turn_y, world_from_camera
from carstudio.scene.terrain import CAMERA_HEIGHT_M, Terrain, terrain_of


@dataclass(frozen=True)
class Surroundings:
    """What edits need to know of a scene beside its tracks; made once, before the first edit."""

    path: EgoPath | None
    terrain: Terrain


def surroundings_of(scene: Scene) -> Surroundings:
    """The ego path and the ground of a scene."""
    return Surroundings(ego_path(scene), terrain_of(scene))


@dataclass(frozen=True)
class _Spot:
    """Coordinates (x, y or None for "on the ground", z) and yaw (None: as it goes) at a frame."""

    at: int
    x: float
    y: float | None
    z: float
    yaw_rad: float | None


def boxes_along(
    places: Sequence[Place],
    axes: AxesName,
    frames: Sequence[SceneFrame],
    size: Vector3,
    scene: Scene,
    around: Surroundings,
    *,
    own: dict[int, PlacedBox] | None = None,
) -> dict[int, PlacedBox]:
    """A box for each of `frames`: straight between places (steady turn), still before the first and after the last.

    Camera places are those of their own frame's camera; with poses they are taken to the world and joined there, so
    that a car that stands stays where it is. `car` places are relative to the track's `own` box at that frame.
    """
    spots = [_spot(place) for place in sorted(places, key=lambda place: place.at)]
    for before, after in pairwise(spots):
        if before.at == after.at:
            raise InputError(f"two poses at frame {after.at}; leave one out")
    if axes == "car":
        spots, axes = [_from_car(spot, own or {}) for spot in spots], "camera"
    if axes == "camera" and all(_has_pose(scene, spot.at) for spot in spots) and all(_posed(frame) for frame in frames):
        spots, axes = [_to_world(spot, scene, around) for spot in spots], "world"
    return {frame.index: _box(_between(spots, frame.index), axes, frame, size, around) for frame in frames}


def _spot(place: Place) -> _Spot:
    yaw = None if place.yaw_deg is None else math.radians(place.yaw_deg)
    if len(place.position_m) == 2:
        x, z = place.position_m
        return _Spot(place.at, x, None, z, yaw)
    x, y, z = place.position_m
    return _Spot(place.at, x, y, z, yaw)


def _between(spots: Sequence[_Spot], index: int) -> _Spot:
    """The spot at a frame; its yaw is filled from the way where neither neighbour has one."""
    if index <= spots[0].at:
        return _with_way(spots[0], spots[0], spots[min(1, len(spots) - 1)])
    if index >= spots[-1].at:
        return _with_way(spots[-1], spots[max(0, len(spots) - 2)], spots[-1])
    number = next(i for i, spot in enumerate(spots) if spot.at > index)
    a, b = spots[number - 1], spots[number]
    share = (index - a.at) / (b.at - a.at)
    y = None if a.y is None or b.y is None else a.y + share * (b.y - a.y)
    yaw_a, yaw_b = _with_way(a, a, b).yaw_rad, _with_way(b, a, b).yaw_rad
    yaw = None
    if yaw_a is not None and yaw_b is not None:
        yaw = yaw_a + share * math.remainder(yaw_b - yaw_a, 2 * math.pi)
    return _Spot(index, a.x + share * (b.x - a.x), y, a.z + share * (b.z - a.z), yaw)


def _with_way(spot: _Spot, start: _Spot, end: _Spot) -> _Spot:
    """The spot, facing from `start` to `end` where it has no yaw of its own; no yaw when these are one place."""
    dx, dz = end.x - start.x, end.z - start.z
    if spot.yaw_rad is not None or math.hypot(dx, dz) < 1e-6:
        return spot
    return _Spot(spot.at, spot.x, spot.y, spot.z, math.atan2(-dz, dx))


def _box(spot: _Spot, axes: AxesName, frame: SceneFrame, size: Vector3, around: Surroundings) -> PlacedBox:
    rotation, bottom = _in_camera(spot, axes, frame, around)
    if spot.y is None:
        bottom = np.array([bottom[0], around.terrain.height(frame, bottom[0], bottom[2]), bottom[2]])
    return box_standing(rotation, bottom, size)


def _in_camera(spot: _Spot, axes: AxesName, frame: SceneFrame, around: Surroundings) -> tuple[np.ndarray, np.ndarray]:
    """`camera_from_car`'s rotation and the bottom centre of a spot in a frame's camera."""
    if axes == "camera":
        yaw = spot.yaw_rad if spot.yaw_rad is not None else road_yaw(frame, np.array([spot.x, 0, spot.z]), around)
        return turn_y(yaw), np.array([spot.x, CAMERA_HEIGHT_M if spot.y is None else spot.y, spot.z])
    if axes == "path" and around.path is None:  # no poses: the road goes where the camera looks
        low = CAMERA_HEIGHT_M if spot.y is None else spot.y
        return turn_y((spot.yaw_rad or 0.0) - math.pi / 2), np.array([-spot.z, low, spot.x])
    pose = need_pose(frame, axes)
    if axes == "path":
        assert around.path is not None
        down = CAMERA_HEIGHT_M if spot.y is None else spot.y
        point, path_yaw = around.path.from_path(spot.x, down, spot.z)
        turn = turn_y(path_yaw + (spot.yaw_rad or 0.0))
    else:
        point = np.array([spot.x, _world_height(pose) if spot.y is None else spot.y, spot.z])
        along_road = around.path.to_path(point)[1] if spot.yaw_rad is None and around.path is not None else 0.0
        turn = turn_y(along_road if spot.yaw_rad is None else spot.yaw_rad)
    return pose[:3, :3].T @ turn, pose[:3, :3].T @ (point - pose[:3, 3])


def road_yaw(frame: SceneFrame, point: np.ndarray, around: Surroundings) -> float:
    """Yaw (rad, camera frame) of a car that faces along the road at a point of a frame's camera frame."""
    pose = world_from_camera(frame)
    if pose is None or around.path is None:
        return -math.pi / 2
    _, yaw = around.path.to_path(pose[:3, :3] @ point + pose[:3, 3])
    return heading(pose[:3, :3].T @ turn_y(yaw))


def need_pose(frame: SceneFrame, axes: str) -> Pose:
    """A frame's pose; `InputError` when the log has none."""
    pose = world_from_camera(frame)
    if pose is None:
        raise InputError(f"frame: {axes} needs the camera's pose, which frame {frame.index} does not have; use camera")
    return pose


def _from_car(spot: _Spot, own: dict[int, PlacedBox]) -> _Spot:
    if spot.at not in own:
        raise InputError(f"frame: car counts from the car's own box, and it has none in frame {spot.at}")
    pose = pose_of(own[spot.at])
    low = own[spot.at].size[1] / 2 + (0.0 if spot.y is None else spot.y)  # y counts from where it stands
    x, y, z = (pose[:3, :3] @ np.array([spot.x, low, spot.z]) + pose[:3, 3]).tolist()
    return _Spot(spot.at, x, None if spot.y is None else y, z, heading(pose[:3, :3]) + (spot.yaw_rad or 0.0))


def _to_world(spot: _Spot, scene: Scene, around: Surroundings) -> _Spot:
    frame = scene.frame(spot.at)
    pose = need_pose(frame, "camera")
    low = around.terrain.height(frame, spot.x, spot.z) if spot.y is None else spot.y
    point = pose[:3, :3] @ np.array([spot.x, low, spot.z]) + pose[:3, 3]
    yaw = None if spot.yaw_rad is None else heading(pose[:3, :3] @ turn_y(spot.yaw_rad))
    return _Spot(spot.at, float(point[0]), None if spot.y is None else float(point[1]), float(point[2]), yaw)


def _world_height(pose: Pose) -> float:
    return float(pose[1, 3] + pose[1, 1] * CAMERA_HEIGHT_M)


def _posed(frame: SceneFrame) -> bool:
    return frame.world_from_camera is not None


def _has_pose(scene: Scene, index: int) -> bool:
    return any(frame.index == index and _posed(frame) for frame in scene.frames)
