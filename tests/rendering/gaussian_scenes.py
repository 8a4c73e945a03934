"""Clouds of Gaussians, a car's box and a camera that the tests of Gaussians share."""

import torch
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.gaussian_template import surface_template
from carstudio.rendering.gaussians.cloud import GaussianCloud


def random_cloud(count: int = 60, dtype: torch.dtype = torch.float64, seed: int = 0) -> GaussianCloud:
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(1, count, 14, generator=generator, dtype=torch.float64).to(dtype)
    quaternion = draw[..., 6:10] * 2 - 1
    return GaussianCloud(
        draw[..., :3] * 1.6 - 0.8, (draw[..., 3:6] * 0.2 + 0.03).log(), quaternion, draw[..., 10], draw[..., 11:]
    )


def surface_cloud(count: int = 400, dtype: torch.dtype = torch.float64) -> GaussianCloud:
    """Like a trained car: nearly opaque thin discs on a closed surface."""
    template = surface_template(count, is_half=False)
    colours = torch.rand(1, count, 3, generator=torch.Generator().manual_seed(3))
    parts = template.mean[None], template.log_scale[None], template.quaternion[None], torch.full((1, count), 0.95)
    return GaussianCloud(*(part.to(dtype) for part in (*parts, colours)))


def car_box(
    dtype: torch.dtype = torch.float64, azimuth_deg: float = 35.0, distance_m: float = 9.0, elevation_deg: float = 10.0
) -> Box3D:
    box = orbit_box(
        torch.tensor([4.2, 1.55, 1.8]), azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, distance_m=distance_m
    )
    return Box3D(box.center[None].to(dtype), box.size[None].to(dtype), box.rotation[None].to(dtype))


def camera(side: int, dtype: torch.dtype = torch.float64) -> Camera:
    return Camera(orbit_camera(side).intrinsics.to(dtype), side, side)


def leaves(cloud: GaussianCloud) -> list[Tensor]:
    return [value.clone().requires_grad_() for value in list(vars(cloud).values())[:5]]
