import math

import numpy as np
import pytest
import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.transforms import rotation_from_quaternion, rotation_y
from carstudio.rendering.rays import image_positions, image_rays, pixel_rays, to_canonical
from rendering.scenes import KITTI_INTRINSICS, batched, kitti_camera, positions_on_box, tilted_box


def test_a_ray_passes_through_its_pixel() -> None:
    camera = kitti_camera()
    positions = torch.tensor([[[0.5, 0.5], [609.5593, 172.854], [1241.5, 374.5]]], dtype=torch.float64)
    rays = pixel_rays(batched(camera), positions)
    assert torch.allclose(rays.directions.norm(dim=-1), torch.ones(1, 3, dtype=torch.float64))
    assert torch.allclose(batched(camera).project(rays.origins + 7.3 * rays.directions), positions)
    assert torch.allclose(rays.directions[0, 1], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_radius_is_mip_nerfs_neighbour_distance() -> None:
    """mip-NeRF's own way: distance between neighbouring un-normalised directions times 2 / sqrt(12), per z."""
    fx, fy, cx, cy = KITTI_INTRINSICS
    u, v = 900.5, 300.5
    here, right = np.array([(u - cx) / fx, (v - cy) / fy, 1.0]), np.array([(u + 1 - cx) / fx, (v - cy) / fy, 1.0])
    expected = np.linalg.norm(right - here) * 2 / math.sqrt(12) / np.linalg.norm(here)
    rays = pixel_rays(batched(kitti_camera()), torch.tensor([[[u, v]]], dtype=torch.float64))
    assert float(rays.radii) == pytest.approx(expected, rel=1e-12)


def test_rays_of_a_crop_are_rays_of_the_frame() -> None:
    frame = kitti_camera()
    crop = frame.crop(600, 150, 40, 20)
    whole = pixel_rays(batched(frame), image_positions(40, 20, frame.intrinsics)[None] + torch.tensor([600.0, 150.0]))
    part = image_rays(crop)
    assert torch.allclose(part.directions, whole.directions, atol=1e-14)
    assert torch.allclose(part.radii, whole.radii, rtol=1e-12)


def test_rays_of_a_resized_image_pass_through_the_same_places() -> None:
    """Twice the size: the corner between four small pixels is the centre of the large one."""
    small = kitti_camera().crop(600, 150, 40, 20)
    large = small.resize(80, 40)
    rays = image_rays(large).directions.reshape(20, 2, 40, 2, 3).mean(dim=(1, 3))
    assert torch.allclose(
        torch.nn.functional.normalize(rays, dim=-1), image_rays(small).directions.reshape(20, 40, 3), atol=2e-7
    )


def test_image_positions_run_row_by_row() -> None:
    positions = image_positions(3, 2, torch.zeros(1))
    assert positions.tolist() == [[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]


def test_canonical_rays_equal_the_releases_formula() -> None:
    """S [R^T | -R^T t] G applied to OpenGL directions, written out with numpy for a KITTI label."""
    yaw, length, height, width = 0.7, 4.1, 1.5, 1.7
    bottom = np.array([2.0, 1.6, 11.0])
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    t = bottom - np.array([0, height / 2, 0])
    S, G = np.diag([2 / length, 2 / height, 2 / width]), np.diag([1.0, -1.0, -1.0])
    fx, fy, cx, cy = KITTI_INTRINSICS
    u, v = 720.5, 200.5
    opengl = np.array([(u - cx) / fx, -(v - cy) / fy, -1.0])
    direction = S @ R.T @ G @ opengl / np.linalg.norm(opengl)

    box = Box3D(torch.tensor(t)[None], torch.tensor([[length, height, width]]).double(), torch.tensor(R)[None])
    rays = to_canonical(pixel_rays(batched(kitti_camera()), torch.tensor([[[u, v]]]).double()), box)
    np.testing.assert_allclose(rays.directions[0, 0].numpy(), direction, rtol=1e-6)
    np.testing.assert_allclose(rays.origins[0, 0].numpy(), -S @ R.T @ t, rtol=1e-6)


def test_near_and_far_lie_on_the_boxs_surface() -> None:
    box, camera = tilted_box(), kitti_camera()
    rays = pixel_rays(batched(camera), positions_on_box(box, camera, 200))
    canonical = to_canonical(rays, box)
    assert bool(canonical.hit.all())
    for distance in (canonical.near, canonical.far):
        metric = rays.origins + distance[..., None] * rays.directions
        in_car = (metric - box.center[:, None]) @ box.rotation
        reach = (in_car.abs() / (box.size[:, None] / 2)).amax(dim=-1)
        assert torch.allclose(reach, torch.ones_like(reach), atol=1e-9)
    assert bool((canonical.near < canonical.far).all())


def test_turning_camera_and_car_together_changes_nothing() -> None:
    box, camera = tilted_box(), kitti_camera()
    rays = pixel_rays(batched(camera), positions_on_box(box, camera, 50))
    turn = rotation_from_quaternion(torch.tensor([0.3, -0.5, 0.7, 0.2], dtype=torch.float64))
    shift = torch.tensor([3.0, -2.0, 5.0], dtype=torch.float64)
    moved_box = Box3D(box.center @ turn.T + shift, box.size, turn @ box.rotation)
    moved = type(rays)(rays.origins @ turn.T + shift, rays.directions @ turn.T, rays.radii)
    a, b = to_canonical(rays, box), to_canonical(moved, moved_box)
    for name in ("origins", "directions", "near", "far"):
        assert torch.allclose(getattr(a, name), getattr(b, name), atol=1e-10), name


def test_stretch_along_length_and_width() -> None:
    """Worked out by hand: 0.48 along the length, 1.11 along the width of a 4.2 x 1.5 x 1.8 m car."""
    size = torch.tensor([[4.2, 1.5, 1.8]], dtype=torch.float64)
    forward = pixel_rays(batched(kitti_camera()), torch.tensor([[KITTI_INTRINSICS[2:]]], dtype=torch.float64))
    for yaw, expected in ((-math.pi / 2, 2 / 4.2), (0.0, 2 / 1.8)):
        rotation = rotation_y(torch.tensor([yaw], dtype=torch.float64))
        box = Box3D(torch.tensor([[0.0, 0.0, 10.0]], dtype=torch.float64), size, rotation)
        assert float(to_canonical(forward, box).stretch) == pytest.approx(expected, rel=1e-9)


def test_rays_beside_and_behind_miss() -> None:
    box = tilted_box(torch.float32)
    corner = pixel_rays(batched(kitti_camera(torch.float32)), torch.tensor([[[1.0, 1.0]]]))
    behind = Box3D(box.center * -1, box.size, box.rotation)
    center = pixel_rays(batched(kitti_camera(torch.float32)), positions_on_box(box, kitti_camera(torch.float32), 5))
    assert not bool(to_canonical(corner, box).hit.any())
    missed = to_canonical(center, behind)
    assert not bool(missed.hit.any())
    assert float(missed.near.abs().max()) == 0.0
    assert float(missed.far.abs().max()) == 0.0
