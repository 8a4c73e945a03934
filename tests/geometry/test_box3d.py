"""Boxes: corners, KITTI's bottom centre, mirroring, and the outline in the image, against loops and dense samples."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from carstudio.geometry.box3d import (
    BOX_EDGES,
    CUBE_CORNERS,
    Box3D,
    box_from_kitti,
    envelope,
    mirror_box,
    projected_hull_points,
)
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y, transform_points
from oracles import geometry_slow

SIZE = (4.2, 1.5, 1.8)
INTRINSICS = (721.5377, 721.5377, 609.5593, 172.854)
CAMERA = Camera(torch.tensor(INTRINSICS, dtype=torch.float64), 1242, 375)
SEEDS = st.integers(0, 10**6)


def double(values) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float64)


def random_box(seed: int) -> Box3D:
    rng = np.random.default_rng(seed)
    size, center = rng.uniform((3, 1.2, 1.5), (5.5, 2.2, 2.2)), rng.uniform((-8, -2, 8), (8, 3, 50))
    return Box3D(double(center), double(size), double(Rotation.random(random_state=seed).as_matrix()))


def box_at(center, yaw_rad: float = 0.0) -> Box3D:
    return Box3D(double(center), double(SIZE), rotation_y(double(yaw_rad)))


@given(SEEDS)
def test_corners_are_the_cubes_corners_one_by_one(seed):
    box = random_box(seed)
    corners = box.corners().numpy()
    for corner, cube in zip(corners, CUBE_CORNERS, strict=True):
        expected = box.rotation.numpy() @ (np.array(cube) * box.size.numpy() / 2) + box.center.numpy()
        np.testing.assert_allclose(corner, expected, atol=1e-12)
    torch.testing.assert_close(
        transform_points(box.camera_from_car, double(CUBE_CORNERS) * box.size / 2), box.corners()
    )


@given(SEEDS)
def test_corners_span_the_boxs_volume(seed):
    box = random_box(seed)
    assert ConvexHull(box.corners().numpy()).volume == pytest.approx(box.size.prod().item(), rel=1e-10)


def test_a_batch_of_boxes_is_each_box():
    boxes = [random_box(i) for i in range(3)]
    batch = Box3D(*(torch.stack([getattr(b, name) for b in boxes]) for name in ("center", "size", "rotation")))
    for i, box in enumerate(boxes):
        torch.testing.assert_close(batch.corners()[i], box.corners())
        torch.testing.assert_close(batch.yaw_rad[i], box.yaw_rad)
        torch.testing.assert_close(batch.camera_from_car[i], box.camera_from_car)


def test_front_down_and_left_of_a_car_that_drives_away():
    """Yaw -pi/2 looks along +z, as a car in front of us does: its left is then the camera's left, -x."""
    corners = box_at((0.0, 1.0, 10.0), -math.pi / 2).corners().numpy()
    front, bottom, left = corners[4:], corners[[2, 3, 6, 7]], corners[1::2]
    np.testing.assert_allclose(front[:, 2], 10 + 4.2 / 2)
    np.testing.assert_allclose(bottom[:, 1], 1 + 1.5 / 2)
    np.testing.assert_allclose(left[:, 0], -1.8 / 2)


def test_edges_are_the_twelve_of_a_box():
    corners = box_at((0.0, 0.0, 10.0)).corners().numpy()
    lengths = sorted(np.linalg.norm(corners[i] - corners[j]) for i, j in BOX_EDGES)
    np.testing.assert_allclose(lengths, [1.5] * 4 + [1.8] * 4 + [4.2] * 4)
    assert len(set(BOX_EDGES)) == 12


@given(SEEDS, st.floats(-3.2, 3.2))
def test_kitti_labels_give_the_corners_of_kittis_formula(seed, yaw):
    rng = np.random.default_rng(seed)
    bottom, size = rng.uniform((-10, 0, 5), (10, 3, 50)), rng.uniform((3, 1.2, 1.5), (5.5, 2.2, 2.2))
    box = box_from_kitti(double(bottom), double(size), double(yaw))
    np.testing.assert_allclose(box.corners().numpy(), geometry_slow.kitti_corners(bottom, size, yaw), atol=1e-12)
    assert box.yaw_rad.item() == pytest.approx(math.remainder(yaw, 2 * math.pi), abs=1e-12)


def test_the_ground_stays_under_the_wheels():
    """The bottom face keeps the label's y, the top is a height above (y points down), whatever the yaw."""
    box = box_from_kitti(double((1.0, 1.65, 12.0)), double(SIZE), double(0.7))
    heights = box.corners()[:, 1]
    assert heights.max().item() == pytest.approx(1.65)
    assert heights.min().item() == pytest.approx(1.65 - 1.5)


def test_the_camera_offset_moves_the_centre_and_nothing_else():
    plain = box_from_kitti(double((1.0, 1.65, 12.0)), double(SIZE), double(0.7))
    moved = box_from_kitti(double((1.0, 1.65, 12.0)), double(SIZE), double(0.7), double((0.06, -0.0004, 0.003)))
    torch.testing.assert_close(moved.center - plain.center, double((0.06, -0.0004, 0.003)))
    assert torch.equal(moved.rotation, plain.rotation)


def test_one_camera_offset_serves_a_batch_of_labels():
    bottoms = torch.randn(5, 3, dtype=torch.float64)
    offset = double((0.06, -0.0004, 0.003))
    boxes = box_from_kitti(bottoms, double(SIZE).expand(5, 3), torch.zeros(5, dtype=torch.float64), offset)
    expected = bottoms - double((0, 0.75, 0)) + offset
    torch.testing.assert_close(boxes.center, expected)


# --- mirroring --------------------------------------------------------------------------------------------------------


@given(SEEDS)
def test_mirroring_box_and_camera_mirrors_the_picture(seed):
    box = random_box(seed)
    positions = CAMERA.project(box.corners())
    mirrored = CAMERA.flip().project(mirror_box(box).corners())
    expected = torch.stack([CAMERA.width - positions[:, 0], positions[:, 1]], dim=-1)
    # The car's left and right swap: corner z = -1 lands where z = +1 was.
    torch.testing.assert_close(mirrored, expected[[1, 0, 3, 2, 5, 4, 7, 6]], atol=1e-9, rtol=0)


@given(SEEDS)
def test_mirroring_is_proper_and_undoes_itself(seed):
    box = random_box(seed)
    assert torch.linalg.det(mirror_box(box).rotation).item() == pytest.approx(1.0)
    twice = mirror_box(mirror_box(box))
    torch.testing.assert_close(twice.center, box.center)
    torch.testing.assert_close(twice.rotation, box.rotation)


@given(st.floats(-3.1, 3.1))
def test_mirroring_turns_the_yaw_to_pi_minus_yaw(yaw):
    mirrored = mirror_box(box_at((1.0, 0.0, 9.0), yaw)).yaw_rad.item()
    assert math.remainder(mirrored - (math.pi - yaw), 2 * math.pi) == pytest.approx(0.0, abs=1e-12)


# --- the outline ------------------------------------------------------------------------------------------------------


def dense_envelope(box: Box3D, near_m: float = 0.1) -> np.ndarray | None:
    points = geometry_slow.surface_points(box.size.numpy(), box.rotation.numpy(), box.center.numpy())
    points = points[points[:, 2] >= near_m]
    if len(points) == 0:
        return None
    positions = geometry_slow.project(points, INTRINSICS)
    return np.concatenate([positions.min(axis=0), positions.max(axis=0)])


@given(SEEDS)
def test_envelope_is_that_of_opencvs_corners_and_of_dense_samples(seed):
    box = random_box(seed)
    fx, fy, cx, cy = INTRINSICS
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    turn = Rotation.from_matrix(box.rotation.numpy()).as_rotvec()
    cube = np.array(CUBE_CORNERS) * box.size.numpy() / 2
    positions, _ = cv2.projectPoints(cube, turn, box.center.numpy(), matrix, None)
    expected = np.concatenate([positions[:, 0].min(axis=0), positions[:, 0].max(axis=0)])
    ours = envelope(box, CAMERA, clip=False)
    assert ours is not None
    np.testing.assert_allclose(ours.numpy(), expected, atol=1e-6)
    np.testing.assert_allclose(ours.numpy(), dense_envelope(box), atol=1e-6)  # the samples include the corners


@pytest.mark.parametrize("yaw", [0.0, 0.4, -math.pi / 2, 2.5])
@pytest.mark.parametrize("depth_m", [0.3, 1.0, 1.9])
def test_a_box_cut_by_the_near_plane_keeps_its_visible_part(yaw, depth_m):
    """Samples end up to a grid step before the cut edge, where a step is many pixels: compare against the limit."""
    box = box_at((0.4, 1.2, depth_m), yaw)
    ours = envelope(box, CAMERA, clip=False)
    assert ours is not None
    ours = ours.numpy()
    assert np.isfinite(ours).all()
    sampled = dense_envelope(box)
    assert (ours[:2] <= sampled[:2] + 1e-6).all()
    assert (ours[2:] >= sampled[2:] - 1e-6).all()
    cut = cut_by_bisection(box)
    np.testing.assert_allclose(ours, cut, rtol=1e-6)


def cut_by_bisection(box: Box3D, near_m: float = 0.1) -> np.ndarray:
    corners = box.corners().numpy()
    points = [corner for corner in corners if corner[2] >= near_m]
    for i, j in BOX_EDGES:
        front, back = sorted((corners[i], corners[j]), key=lambda p: -p[2])
        if front[2] >= near_m > back[2]:
            for _ in range(80):
                middle = (front + back) / 2
                front, back = (middle, back) if middle[2] >= near_m else (front, middle)
            points.append(front)
    positions = geometry_slow.project(np.array(points), INTRINSICS)
    return np.concatenate([positions.min(axis=0), positions.max(axis=0)])


def test_a_box_behind_the_camera_has_no_outline():
    box = box_at((0.0, 1.0, -10.0))
    assert projected_hull_points(box, CAMERA).shape == (0, 2)
    assert envelope(box, CAMERA) is None
    assert dense_envelope(box) is None


def test_around_the_camera_the_box_fills_the_picture():
    box = box_at((0.0, 0.0, 0.0))
    filled = envelope(box, CAMERA)
    assert filled is not None
    assert filled.tolist() == [0.0, 0.0, 1242.0, 375.0]


def test_envelope_is_clipped_to_the_picture_or_none_outside():
    partly = envelope(box_at((-9.0, 1.0, 10.0)), CAMERA)
    whole = envelope(box_at((-9.0, 1.0, 10.0)), CAMERA, clip=False)
    assert partly is not None
    assert whole is not None
    assert whole[0] < 0
    assert partly[0] == 0
    assert torch.equal(partly[1:], whole[1:])
    assert envelope(box_at((-40.0, 1.0, 10.0)), CAMERA) is None
    assert envelope(box_at((-40.0, 1.0, 10.0)), CAMERA, clip=False) is not None


def test_world_and_camera_turned_together_change_nothing():
    """An image position depends on the box in the camera's frame only: turn both and the outline stays."""
    turn = double(Rotation.random(random_state=5).as_matrix())
    world_box = random_box(11)
    camera_from_world = turn
    seen = Box3D(camera_from_world @ world_box.center, world_box.size, camera_from_world @ world_box.rotation)
    back = Box3D(turn.mT @ seen.center, seen.size, turn.mT @ seen.rotation)
    torch.testing.assert_close(envelope(back, CAMERA, clip=False), envelope(world_box, CAMERA, clip=False))


def test_corners_have_the_right_gradients():
    box = random_box(2)
    parts = [p.clone().requires_grad_() for p in (box.center, box.size, box.rotation)]
    assert torch.autograd.gradcheck(lambda c, s, r: Box3D(c, s, r).corners(), parts)


def test_outline_has_finite_gradients_where_it_is_cut():
    center = double((0.4, 1.2, 1.0)).requires_grad_()
    outline = envelope(Box3D(center, double(SIZE), rotation_y(double(0.4))), CAMERA, clip=False)
    assert outline is not None
    (gradient,) = torch.autograd.grad(outline.sum(), center)
    assert torch.isfinite(gradient).all()
