"""Rotations and rigid transforms against scipy, numpy's inverse, the group axioms and finite differences."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from carstudio.geometry.transforms import (
    invert_rigid,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
    rotation_y,
    transform_directions,
    transform_points,
    yaw_from_rotation,
)
from oracles import geometry_slow

ANGLES = st.floats(-7.0, 7.0)
SEEDS = st.integers(0, 2**31 - 1)


def random_rotations(n: int, seed: int) -> np.ndarray:
    return Rotation.random(n, random_state=seed).as_matrix()


def random_rigid(n: int, seed: int) -> torch.Tensor:
    translation = np.random.default_rng(seed).normal(scale=20.0, size=(n, 3))
    return rigid(torch.tensor(random_rotations(n, seed)), torch.tensor(translation))


@given(ANGLES)
def test_rotation_y_is_scipys_and_the_releases(yaw):
    ours = rotation_y(torch.tensor(yaw, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_euler("y", yaw).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(ours, geometry_slow.rotation_y(yaw), atol=1e-14)


@pytest.mark.parametrize(
    ("yaw", "front"),
    [(0.0, (1, 0, 0)), (-math.pi / 2, (0, 0, 1)), (math.pi / 2, (0, 0, -1)), (math.pi, (-1, 0, 0))],
)
def test_yaw_turns_the_front_as_kitti_says(yaw, front):
    turned = rotation_y(torch.tensor(yaw, dtype=torch.float64)) @ torch.tensor([1.0, 0, 0], dtype=torch.float64)
    np.testing.assert_allclose(turned.numpy(), front, atol=1e-15)


@given(ANGLES)
def test_yaw_round_trip_wraps_to_one_turn(yaw):
    back = yaw_from_rotation(rotation_y(torch.tensor(yaw, dtype=torch.float64))).item()
    assert -math.pi <= back <= math.pi
    assert math.isclose(math.remainder(back - yaw, 2 * math.pi), 0.0, abs_tol=1e-12)


@given(SEEDS)
def test_yaw_of_a_tilted_box_is_the_heading_of_its_front(seed):
    rotation = random_rotations(1, seed)[0]
    front = rotation @ np.array([1.0, 0.0, 0.0])
    heading = np.arctan2(-front[2], front[0])  # yaw 0 is +x, -pi/2 is +z
    assert yaw_from_rotation(torch.tensor(rotation)).item() == pytest.approx(heading, abs=1e-12)


@given(SEEDS)
def test_rotation_from_quaternion_is_scipys_for_any_length(seed):
    rotation = Rotation.random(5, random_state=seed)
    x, y, z, w = rotation.as_quat().T
    scale = np.random.default_rng(seed).uniform(0.1, 10.0, size=(5, 1))
    ours = rotation_from_quaternion(torch.tensor(np.stack([w, x, y, z], axis=-1) * scale))
    np.testing.assert_allclose(ours.numpy(), rotation.as_matrix(), atol=1e-13)
    np.testing.assert_allclose((ours @ ours.mT).numpy(), np.broadcast_to(np.eye(3), (5, 3, 3)), atol=1e-13)


def test_a_quaternion_and_its_negative_turn_alike():
    quaternion = torch.randn(20, 4, dtype=torch.float64)
    torch.testing.assert_close(rotation_from_quaternion(quaternion), rotation_from_quaternion(-quaternion))


@given(SEEDS)
def test_quaternion_from_rotation_is_scipys_with_positive_w(seed):
    rotation = Rotation.random(5, random_state=seed)
    x, y, z, w = rotation.as_quat(canonical=True).T
    ours = quaternion_from_rotation(torch.tensor(rotation.as_matrix())).numpy()
    np.testing.assert_allclose(ours, np.stack([w, x, y, z], axis=-1), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1.0, math.pi - 1e-4, math.pi - 1e-7, math.pi])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, -2, 3), (-1, -1, -1)])
def test_quaternion_round_trip_holds_at_every_angle_in_single_precision(angle, axis):
    rotation = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    quaternion = quaternion_from_rotation(torch.tensor(rotation, dtype=torch.float32))
    assert quaternion[0] >= 0
    assert quaternion.norm().item() == pytest.approx(1.0, abs=1e-6)
    # A half turn must not lose half the digits: the naive form through sqrt(1 + trace) is off by 1e-3 here.
    np.testing.assert_allclose(rotation_from_quaternion(quaternion).numpy(), rotation, atol=1e-6)


def test_quaternion_functions_have_the_right_gradients():
    quaternion = torch.randn(3, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rotation_from_quaternion, (quaternion,))
    rotation = torch.tensor(random_rotations(3, 1), requires_grad=True)
    assert torch.autograd.gradcheck(quaternion_from_rotation, (rotation,))


@given(SEEDS)
def test_rigid_transforms_form_a_group(seed):
    a, b, c = random_rigid(3, seed)
    identity = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(a @ invert_rigid(a), identity, atol=1e-12, rtol=0)
    torch.testing.assert_close(invert_rigid(a) @ a, identity, atol=1e-12, rtol=0)
    torch.testing.assert_close(invert_rigid(a @ b), invert_rigid(b) @ invert_rigid(a), atol=1e-11, rtol=0)
    points = torch.tensor(np.random.default_rng(seed).normal(size=(6, 3)))
    one_by_one = transform_points(a, transform_points(b, transform_points(c, points)))
    torch.testing.assert_close(transform_points(a @ b @ c, points), one_by_one, atol=1e-11, rtol=0)
    torch.testing.assert_close(invert_rigid(rigid(torch.eye(3).double(), points[0]))[:3, 3], -points[0])


@given(SEEDS)
def test_invert_rigid_is_numpys_inverse(seed):
    transforms = random_rigid(4, seed)
    np.testing.assert_allclose(invert_rigid(transforms).numpy(), np.linalg.inv(transforms.numpy()), atol=1e-11)


def test_rigid_puts_every_number_in_its_place():
    rotation, translation = torch.arange(9.0).reshape(3, 3), torch.tensor([10.0, 11.0, 12.0])
    expected = [[0, 1, 2, 10], [3, 4, 5, 11], [6, 7, 8, 12], [0, 0, 0, 1]]
    assert rigid(rotation, translation).tolist() == expected


@given(SEEDS)
def test_points_and_directions_follow_the_homogeneous_product(seed):
    rng = np.random.default_rng(seed)
    transforms, points = rng.normal(size=(2, 4, 4)), rng.normal(size=(2, 5, 3))
    transforms[:, 3] = [0, 0, 0, 1]
    moved = transform_points(torch.tensor(transforms), torch.tensor(points)).numpy()
    turned = transform_directions(torch.tensor(transforms), torch.tensor(points)).numpy()
    for batch in range(2):
        for i in range(5):
            np.testing.assert_allclose(moved[batch, i], (transforms[batch] @ [*points[batch, i], 1])[:3], atol=1e-12)
            np.testing.assert_allclose(turned[batch, i], (transforms[batch] @ [*points[batch, i], 0])[:3], atol=1e-12)


def test_a_direction_is_a_difference_of_points():
    transform = random_rigid(1, 7)[0]
    a, b = torch.randn(2, 4, 3, dtype=torch.float64)
    difference = transform_points(transform, a) - transform_points(transform, b)
    torch.testing.assert_close(transform_directions(transform, a - b), difference, atol=1e-12, rtol=0)


def test_transforms_have_the_right_gradients():
    transform = random_rigid(2, 3).requires_grad_()
    points = torch.randn(2, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transform_points, (transform, points))
    assert torch.autograd.gradcheck(transform_directions, (transform, points))
    assert torch.autograd.gradcheck(invert_rigid, (transform,))
    yaw = torch.randn(4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda angle: yaw_from_rotation(rotation_y(angle)), (yaw,))
