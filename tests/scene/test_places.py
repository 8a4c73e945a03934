"""Poses, yaw and collisions against brute force; the ego path against its definition."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from carstudio.geometry.transforms import rotation_y
from carstudio.scene.graph import PlacedBox
from carstudio.scene.path import ego_path
from carstudio.scene.places import as_ranges, box_at, box_standing, collide, pose_of, standing, turn_y
from carstudio.scene.terrain import terrain_of
from scene.made_up_scene import HEIGHT_M, SIZE, camera_pose, frame, made_up_scene

angles = st.floats(-math.pi, math.pi)


@given(angles)
def test_the_turn_is_the_projects_own(yaw: float) -> None:
    assert np.allclose(turn_y(yaw), rotation_y(torch.tensor(yaw, dtype=torch.float64)).numpy(), atol=1e-12)


@given(angles, st.floats(-5, 5), st.floats(5, 30))
def test_a_box_comes_back_from_its_pose_and_from_where_it_stands(yaw: float, x: float, z: float) -> None:
    box = box_standing(turn_y(yaw), np.array([x, 1.6, z]), SIZE)
    assert np.allclose(standing(box), [x, 1.6, z], atol=1e-9)
    assert math.isclose(box.center[1], 1.6 - SIZE[1] / 2, abs_tol=1e-9)  # y points down
    again = box_at(pose_of(box), SIZE)
    assert np.allclose(pose_of(again), pose_of(box), atol=1e-9)


def inside(points: np.ndarray, box: PlacedBox) -> np.ndarray:
    pose = pose_of(box)
    local = np.abs((points - pose[:3, 3]) @ pose[:3, :3])
    return (local <= np.array(box.size) / 2).all(axis=1)


@given(angles, angles, st.floats(-5, 5), st.floats(-5, 5), st.floats(-2, 2))
def test_collisions_are_those_that_points_find(yaw: float, other: float, x: float, z: float, y: float) -> None:
    a = box_standing(turn_y(yaw), np.array([0.0, 1.6, 10.0]), SIZE)
    b = box_standing(turn_y(other), np.array([x, 1.6 + y, 10.0 + z]), (3.0, 1.2, 1.5))
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 31)] * 3, indexing="ij"), -1).reshape(-1, 3)
    pose = pose_of(b)
    points = grid * np.array(b.size) / 2 @ pose[:3, :3].T + pose[:3, 3]
    found = bool(inside(points, a).any())
    assert found <= collide(a, b)
    assert collide(a, b) == collide(b, a)
    larger = box_at(pose_of(a), (SIZE[0] + 0.3, SIZE[1] + 0.3, SIZE[2] + 0.3))
    assert collide(a, b) <= bool(inside(points, larger).any())  # the grid is finer than what is added


@given(st.floats(-30, 60), st.floats(-1, 2), st.floats(-9, 9))
def test_path_coordinates_come_back(along: float, down: float, left: float) -> None:
    path = ego_path(made_up_scene())
    assert path is not None
    point, yaw = path.from_path(along, down, left)
    found, same_yaw = path.to_path(point)
    assert np.allclose(found, [along, down, left], atol=1e-6)
    assert abs(math.remainder(yaw - same_yaw, 2 * math.pi)) < 1e-6


def test_the_path_goes_where_the_camera_goes_and_its_left_is_left() -> None:
    path = ego_path(made_up_scene())
    assert path is not None
    for index in range(2, 10):
        pose = camera_pose(index)
        (along, down, left), yaw = path.to_path(pose[:3, 3])
        assert math.isclose(along, 1.5 * index, abs_tol=0.01)
        assert abs(down) < 1e-9
        assert abs(left) < 1e-9
        ahead = turn_y(yaw) @ [1.0, 0, 0]
        assert ahead @ pose[:3, 2] > 0.999  # the path's x axis is where the camera looks
        beside, _ = path.to_path(pose[:3, 3] - 2.0 * pose[:3, 0])  # two metres to the camera's left
        assert math.isclose(beside[2], 2.0, abs_tol=0.01)


def test_a_scene_without_poses_has_no_path() -> None:
    assert ego_path(made_up_scene(has_poses=False)) is None


@pytest.mark.parametrize("has_poses", [True, False])
def test_the_ground_is_where_boxes_stand(has_poses: bool) -> None:
    scene = made_up_scene(has_poses=has_poses)
    terrain = terrain_of(scene)
    for x, z in ((0.0, 8.0), (-3.0, 20.0), (4.0, 25.0)):
        assert math.isclose(terrain.height(scene.frame(5), x, z), HEIGHT_M, abs_tol=0.02)


def test_the_ground_follows_a_slope() -> None:
    scene = made_up_scene(has_poses=False)
    boxes = [box_standing(turn_y(0.0), np.array([x, 1.65 - 0.05 * z, z]), SIZE) for x in (-4.0, 4.0) for z in (10, 20)]
    tracks = {
        str(i): type(scene.tracks["1"])(track_id=str(i), boxes={0: b}, labels={0: {}}) for i, b in enumerate(boxes)
    }
    sloping = type(scene)(root="", source="", licence="", frames=(frame(0, has_pose=False),), tracks=tracks)
    height = terrain_of(sloping).height(sloping.frame(0), 0.0, 15.0)
    assert math.isclose(height, 1.65 - 0.05 * 15, abs_tol=0.1)


@given(st.sets(st.integers(0, 40)))
def test_ranges_name_each_number(numbers: set[int]) -> None:
    named: set[int] = set()
    for part in filter(None, as_ranges(numbers).split(", ")):
        first, _, last = part.partition("-")
        named |= set(range(int(first), int(last or first) + 1))
    assert named == numbers
