"""The canonical frame against the release's chain of matrices; ray-box intervals against faces and random points."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from carstudio.geometry.box3d import CUBE_CORNERS, Box3D, box_from_kitti
from carstudio.geometry.canonical import (
    canonical_from_camera,
    canonical_from_car,
    opencv_from_opengl,
    ray_cube_interval,
)
from carstudio.geometry.transforms import transform_directions, transform_points
from oracles import geometry_slow

SEEDS = st.integers(0, 10**6)


def double(values) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def random_box(seed: int) -> Box3D:
    rng = np.random.default_rng(seed)
    size, center = rng.uniform((3, 1.2, 1.5), (5.5, 2.2, 2.2)), rng.uniform((-8, -2, 6), (8, 3, 40))
    return Box3D(double(center), double(size), double(Rotation.random(random_state=seed).as_matrix()))


# --- the frame --------------------------------------------------------------------------------------------------------


@given(SEEDS, st.floats(-3.2, 3.2))
def test_canonical_is_the_releases_chain(seed, yaw):
    rng = np.random.default_rng(seed)
    bottom, size = rng.uniform((-10, 0, 5), (10, 3, 50)), rng.uniform((3, 1.2, 1.5), (5.5, 2.2, 2.2))
    expected = geometry_slow.canonical_from_opengl_camera(bottom, size, yaw)
    box = box_from_kitti(double(bottom), double(size), double(yaw))
    ours = canonical_from_camera(box) @ opencv_from_opengl(box.center)
    np.testing.assert_allclose(ours.numpy(), expected, atol=1e-12)


@given(SEEDS)
def test_the_box_becomes_the_cube(seed):
    box = random_box(seed)
    moved = transform_points(canonical_from_camera(box), box.corners())
    torch.testing.assert_close(moved, double(CUBE_CORNERS), atol=1e-12, rtol=0)


@given(SEEDS)
def test_canonical_is_the_inverse_of_scaling_turning_and_moving(seed):
    box = random_box(seed)
    forward = box.camera_from_car.numpy() @ np.diag([*(box.size.numpy() / 2), 1.0])
    np.testing.assert_allclose(canonical_from_camera(box).numpy(), np.linalg.inv(forward), atol=1e-10)


def test_canonical_by_hand():
    """A 4 x 1.5 x 2 m car 10 m ahead that drives away: 1 m further on is half a half-length."""
    box = box_from_kitti(double((0.0, 0.75, 10.0)), double((4.0, 1.5, 2.0)), double(-math.pi / 2))
    points = double([(0, 0, 11), (0, 0.75, 10), (-1, 0, 10)])  # towards its front, its bottom, its left side
    moved = transform_points(canonical_from_camera(box), points)
    torch.testing.assert_close(moved, double([(0.5, 0, 0), (0, 1, 0), (0, 0, 1)]), atol=1e-12, rtol=0)
    assert torch.diagonal(canonical_from_car(box.size)).tolist() == pytest.approx([0.5, 2 / 1.5, 1.0, 1.0])


def test_a_metre_has_the_known_canonical_lengths():
    """Worked out by hand: 0.48 along the length and 1.11 along the width of a 4.2 x 1.5 x 1.8 m car."""
    scale = canonical_from_car(double((4.2, 1.5, 1.8)))
    assert scale[0, 0].item() == pytest.approx(0.48, abs=0.005)
    assert scale[2, 2].item() == pytest.approx(1.11, abs=0.005)


def test_opengl_to_opencv_is_its_own_inverse():
    matrix = opencv_from_opengl(double(0.0))
    torch.testing.assert_close(matrix @ matrix, torch.eye(4, dtype=torch.float64))
    behind = matrix @ double((1.0, 2.0, -5.0, 1.0))  # OpenGL looks along -z with y up
    assert behind.tolist() == [1.0, -2.0, 5.0, 1.0]


def test_canonical_has_the_right_gradients():
    box = random_box(3)
    parts = [p.clone().requires_grad_() for p in (box.center, box.size, box.rotation)]
    assert torch.autograd.gradcheck(lambda c, s, r: canonical_from_camera(Box3D(c, s, r)), parts)


# --- rays -------------------------------------------------------------------------------------------------------------


@given(SEEDS)
def test_intervals_are_those_of_the_six_faces(seed):
    rng = np.random.default_rng(seed)
    origins, directions = rng.uniform(-3, 3, size=(20, 3)), rng.normal(size=(20, 3))
    entry, exit_, hit = ray_cube_interval(double(origins), double(directions))
    for i in range(20):
        expected = geometry_slow.ray_cube_interval(origins[i], directions[i])
        assert bool(hit[i]) == (expected is not None)
        if expected is not None:
            assert (entry[i].item(), exit_[i].item()) == pytest.approx(expected, abs=1e-9)
        else:
            assert (entry[i].item(), exit_[i].item()) == (0.0, 0.0)


@given(SEEDS)
def test_random_points_of_a_ray_are_inside_exactly_within_the_interval(seed):
    rng = np.random.default_rng(seed)
    origins, directions = rng.uniform(-3, 3, size=(20, 1, 3)), rng.normal(size=(20, 1, 3))
    t = rng.uniform(0, 6, size=(20, 200))
    inside = (np.abs(origins + t[..., None] * directions) <= 1).all(axis=-1)
    entry, exit_, _ = ray_cube_interval(double(origins[:, 0]), double(directions[:, 0]))
    within = (t >= entry.numpy()[:, None]) & (t <= exit_.numpy()[:, None])
    assert (inside == within).all()


@given(SEEDS)
def test_canonical_images_of_metric_rays_keep_metres(seed):
    box = random_box(seed)
    rng = np.random.default_rng(seed)
    target = box.center.numpy() + rng.uniform(-0.3, 0.3, size=(10, 3))  # well inside any box
    directions = double(target / np.linalg.norm(target, axis=-1, keepdims=True))
    matrix = canonical_from_camera(box)
    origins = matrix[:3, 3].expand(10, 3)
    entry, exit_, hit = ray_cube_interval(origins, transform_directions(matrix, directions))
    assert hit.all()
    for distance in (entry, exit_):
        on_surface = (distance[:, None] * directions - box.center) @ box.rotation / (box.size / 2)
        torch.testing.assert_close(on_surface.abs().amax(dim=-1), torch.ones(10).double(), atol=1e-9, rtol=0)


def interval(origin, direction, dtype=torch.float32) -> tuple[float, float, bool]:
    entry, exit_, hit = ray_cube_interval(torch.tensor(origin, dtype=dtype), torch.tensor(direction, dtype=dtype))
    return entry.item(), exit_.item(), bool(hit)


@pytest.mark.parametrize("zero", [0.0, -0.0])
@pytest.mark.parametrize("offset", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_rays_parallel_to_faces_pass_through_also_in_a_face(zero, offset):
    assert interval((-3.0, offset, 0.0), (1.0, zero, zero)) == (2.0, 4.0, True)
    assert interval((0.3, offset, 3.0), (zero, zero, -2.0)) == (1.0, 2.0, True)


@pytest.mark.parametrize("offset", [-1.001, 1.001, 50.0])
def test_parallel_rays_beside_the_cube_miss(offset):
    assert interval((-3.0, offset, 0.0), (1.0, 0.0, 0.0)) == (0.0, 0.0, False)


@pytest.mark.parametrize("tiny", [1e-45, 1e-38, 1e-20, -1e-12])
@pytest.mark.parametrize("offset", [-1.0, 0.0, 1.0])
def test_almost_parallel_rays_pass_through(tiny, offset):
    entry, exit_, hit = interval((-3.0, offset, 0.0), (1.0, tiny, 0.0))
    assert hit
    assert (entry, exit_) == pytest.approx((2.0, 4.0))


def test_from_inside_the_interval_starts_at_the_camera():
    assert interval((0.5, 0.0, 0.0), (1.0, 0.0, 0.0)) == (0.0, 0.5, True)
    assert interval((0.0, 0.0, 0.0), (0.0, 0.0, -4.0)) == (0.0, 0.25, True)


def test_a_cube_behind_the_camera_is_missed():
    assert interval((3.0, 0.0, 0.0), (1.0, 0.0, 0.0)) == (0.0, 0.0, False)


def test_a_ray_that_only_touches_an_edge_is_a_miss():
    assert interval((-2.0, 0.0, 0.0), (1.0, 1.0, 0.0))[2] is False
    assert interval((-2.0, 0.0, 0.0), (1.0, 0.999, 0.0))[2] is True


def test_intervals_have_the_right_gradients():
    origins = double([(-3.0, 0.2, 0.1), (0.3, 0.1, -0.2)]).requires_grad_()
    directions = double([(1.0, 0.05, -0.1), (0.2, 0.3, 1.0)]).requires_grad_()
    assert torch.autograd.gradcheck(lambda o, d: ray_cube_interval(o, d)[:2], (origins, directions))


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (1.0, 1e-45, 0.0), (1.0, 1e-30, -1e-25)])
def test_gradients_stay_finite_for_parallel_rays(direction):
    origin = torch.tensor((-3.0, 0.2, 1.0), requires_grad=True)
    along = torch.tensor(direction, requires_grad=True)
    entry, exit_, _ = ray_cube_interval(origin, along)
    gradients = torch.autograd.grad(entry + exit_, (origin, along))
    assert all(torch.isfinite(g).all() for g in gradients)
