"""Cameras and boxes that the rendering tests share."""

import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_from_quaternion

KITTI_INTRINSICS = (721.5377, 721.5377, 609.5593, 172.854)


def kitti_camera(dtype: torch.dtype = torch.float64) -> Camera:
    return Camera(torch.tensor(KITTI_INTRINSICS, dtype=dtype), 1242, 375)


def tilted_box(dtype: torch.dtype = torch.float64, distance_m: float = 9.0) -> Box3D:
    """A car with a full rotation, not a yaw alone, as a batch of one."""
    rotation = rotation_from_quaternion(torch.tensor([0.8, 0.1, 0.55, -0.05], dtype=dtype))
    center = torch.tensor([-1.2, 0.9, distance_m], dtype=dtype)
    return Box3D(center[None], torch.tensor([[4.2, 1.5, 1.8]], dtype=dtype), rotation[None])


def batched(camera: Camera) -> Camera:
    return Camera(camera.intrinsics[None], camera.width, camera.height)


def positions_on_box(box: Box3D, camera: Camera, count: int, seed: int = 0) -> torch.Tensor:
    """Image positions of random points inside the box: their rays are sure to hit it. (1, count, 2)"""
    generator = torch.Generator().manual_seed(seed)
    inside = torch.rand(1, count, 3, generator=generator, dtype=box.center.dtype) * 1.6 - 0.8
    points = (inside * box.size[:, None] / 2) @ box.rotation.mT + box.center[:, None]
    return batched(camera).project(points)
