"""Pinhole cameras against OpenCV, the 3 x 3 matrix, KITTI's own projection, and pictures that are really resampled."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from carstudio.geometry.camera import Camera, camera_offset_from_projection
from oracles import geometry_slow

INTRINSICS = (721.5377, 700.0, 609.5593, 172.854)
# KITTI's camera 2, both benchmarks; by hand: K^-1 P2[:, 3] = (0.0598, -0.0004, 0.0027) m.
P2 = (
    (721.5377, 0.0, 609.5593, 44.85728),
    (0.0, 721.5377, 172.854, 0.2163791),
    (0.0, 0.0, 1.0, 0.002745884),
)


def camera(width: int = 1242, height: int = 375) -> Camera:
    return Camera(torch.tensor(INTRINSICS, dtype=torch.float64), width, height)


def random_points(seed: int, n: int = 8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform((-10, -3, 1.0), (10, 3, 60), size=(n, 3))


@given(st.integers(0, 10**6))
def test_projection_is_opencvs_and_the_matrixs(seed):
    points = random_points(seed)
    fx, fy, cx, cy = INTRINSICS
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    opencv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)
    ours = camera().project(torch.tensor(points)).numpy()
    np.testing.assert_allclose(ours, opencv[:, 0], rtol=1e-10)
    np.testing.assert_allclose(ours, geometry_slow.project(points, INTRINSICS), rtol=1e-12)


@given(st.integers(0, 10**6))
def test_unprojection_inverts_projection_and_keeps_depth(seed):
    points = torch.tensor(random_points(seed))
    back = camera().unproject(camera().project(points), points[:, 2])
    torch.testing.assert_close(back, points, atol=1e-10, rtol=0)


def test_unprojection_by_hand():
    one_right = torch.tensor([[609.5593 + 721.5377, 172.854]], dtype=torch.float64)
    point = camera().unproject(one_right, torch.tensor([4.0], dtype=torch.float64))
    np.testing.assert_allclose(point.numpy(), [[4.0, 0.0, 4.0]], atol=1e-12)


def test_a_batch_of_cameras_is_each_camera():
    intrinsics = torch.tensor([INTRINSICS, (500.0, 510.0, 64.0, 60.0)], dtype=torch.float64)
    points = torch.tensor(np.stack([random_points(1), random_points(2)]))
    together = Camera(intrinsics, 128, 128).project(points)
    for i in range(2):
        torch.testing.assert_close(together[i], Camera(intrinsics[i], 128, 128).project(points[i]))


def blob(center, width: int, height: int) -> np.ndarray:
    """A picture of one smooth spot at an image position: pixel (u, v) is sampled at (u + 0.5, v + 0.5)."""
    v, u = np.mgrid[:height, :width] + 0.5
    return np.exp(-((u - center[0]) ** 2 + (v - center[1]) ** 2) / (2 * 6.0**2))


def centroid(picture: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    return np.array([(u * picture).sum(), (v * picture).sum()]) / picture.sum()


# A spot of a point in space, in a picture that is resampled by other code: where does it end up? Centroids are exact to
# about 1e-3 px here, so a wrong half pixel (0.5 px, or 0.25 px after halving) shows.
POINT = torch.tensor([[0.3, -0.2, 8.0]], dtype=torch.float64)
SMALL = Camera(torch.tensor([300.0, 320.0, 101.3, 77.7], dtype=torch.float64), 240, 160)


def test_the_blob_is_where_the_camera_says():
    position = SMALL.project(POINT)[0].numpy()
    np.testing.assert_allclose(centroid(blob(position, 240, 160)), position, atol=1e-3)


@pytest.mark.parametrize(("width", "height"), [(120, 80), (60, 40), (80, 32), (480, 320)])
def test_resize_follows_a_resized_picture(width, height):
    picture = blob(SMALL.project(POINT)[0].numpy(), 240, 160)
    way = cv2.INTER_AREA if width < 240 else cv2.INTER_LINEAR
    resized = cv2.resize(picture, (width, height), interpolation=way)
    ours = SMALL.resize(width, height)
    assert (ours.width, ours.height) == (width, height)
    np.testing.assert_allclose(ours.project(POINT)[0].numpy(), centroid(resized), atol=5e-3)


def test_crop_follows_a_cropped_picture():
    picture = blob(SMALL.project(POINT)[0].numpy(), 240, 160)
    ours = SMALL.crop(70, 20, 90, 100)
    assert (ours.width, ours.height) == (90, 100)
    np.testing.assert_allclose(ours.project(POINT)[0].numpy(), centroid(picture[20:120, 70:160]), atol=1e-3)


def test_crop_that_sticks_out_follows_a_padded_picture():
    picture = np.pad(blob(SMALL.project(POINT)[0].numpy(), 240, 160), ((5, 0), (12, 0)))
    ours = SMALL.crop(-12, -5, 252, 165)
    np.testing.assert_allclose(ours.project(POINT)[0].numpy(), centroid(picture), atol=1e-3)


def test_flip_follows_a_mirrored_picture():
    picture = blob(SMALL.project(POINT)[0].numpy(), 240, 160)[:, ::-1]
    mirrored = POINT * torch.tensor([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(SMALL.flip().project(mirrored)[0].numpy(), centroid(picture), atol=1e-3)


@given(st.integers(-200, 200), st.integers(-100, 100), st.integers(1, 500), st.integers(1, 300))
def test_crops_compose_and_resizes_undo_themselves(x0, y0, width, height):
    twice = camera().crop(x0, y0, 600, 300).crop(7, -3, width, height)
    once = camera().crop(x0 + 7, y0 - 3, width, height)
    torch.testing.assert_close(twice.intrinsics, once.intrinsics)
    there_and_back = camera().resize(width, height).resize(1242, 375)
    torch.testing.assert_close(there_and_back.intrinsics, camera().intrinsics)
    torch.testing.assert_close(camera().flip().flip().intrinsics, camera().intrinsics)


def test_offset_reproduces_kittis_projection_exactly():
    projection = torch.tensor(P2, dtype=torch.float64)
    points = random_points(3)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ projection.numpy().T
    kitti = homogeneous[:, :2] / homogeneous[:, 2:]
    offset = camera_offset_from_projection(projection)
    np.testing.assert_allclose(offset.numpy(), [0.0598, -0.0004, 0.0027], atol=5e-5)
    ours = Camera(torch.tensor([721.5377, 721.5377, 609.5593, 172.854]).double(), 1242, 375)
    np.testing.assert_allclose(ours.project(torch.tensor(points) + offset).numpy(), kitti, rtol=1e-7)


@pytest.mark.parametrize(("depth_m", "shift_px"), [(5.0, 8.6), (10.0, 4.3), (20.0, 2.2)])
def test_dropping_the_offset_moves_a_box_by_the_known_amount(depth_m, shift_px):
    offset = camera_offset_from_projection(torch.tensor(P2, dtype=torch.float64))
    ours = Camera(torch.tensor([721.5377, 721.5377, 609.5593, 172.854]).double(), 1242, 375)
    point = torch.tensor([[0.0, 0.0, depth_m]], dtype=torch.float64)
    shift = (ours.project(point + offset) - ours.project(point))[0, 0].item()
    assert shift == pytest.approx(shift_px, abs=0.051)


def test_projection_has_the_right_gradients():
    points = torch.tensor(random_points(4), requires_grad=True)
    intrinsics = torch.tensor(INTRINSICS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda k, p: Camera(k, 1242, 375).project(p), (intrinsics, points))
    positions, depth = torch.randn(5, 2).double().requires_grad_(), torch.rand(5).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda k, p, d: Camera(k, 9, 9).unproject(p, d), (intrinsics, positions, depth))
