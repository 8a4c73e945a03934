"""Rays and cones of a pinhole camera, in metres, and their images in the canonical frame.

A ray is o + t d with |d| = 1, so t is the metric distance. Everything is laid out (batch, ray, ...): one camera and one
box per batch entry, n rays each. Car-Studio Eq. 2; mip-NeRF section 3.1 for the cone's radius.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera, ray_cube_interval
from carstudio.geometry.transforms import transform_directions, transform_points


@dataclass(frozen=True)
class Rays:
    """Rays in the camera frame. `radii` is the cone's radius at one metre of distance."""

    origins: Float[Tensor, "batch ray 3"]
    directions: Float[Tensor, "batch ray 3"]
    radii: Float[Tensor, "batch ray"]

    def to(self, device: torch.device | str) -> "Rays":
        """The same rays on another device."""
        return Rays(self.origins.to(device), self.directions.to(device), self.radii.to(device))

    def select(self, index: Tensor | slice) -> "Rays":
        """Some of the rays of every batch entry."""
        return Rays(self.origins[:, index], self.directions[:, index], self.radii[:, index])


def pixel_rays(camera: Camera, positions: Float[Tensor, "batch ray 2"]) -> Rays:
    """Rays through image positions (px, pixel centres at +0.5) of a batch of cameras.

    The radius is mip-NeRF's: the disc of the pixel's variance, 2 / sqrt(12) pixel widths at z = 1, per unit distance.
    """
    depth_one = torch.ones_like(positions[..., 0])
    through = camera.unproject(positions, depth_one)
    norm = through.norm(dim=-1)
    pixel_width = (camera.intrinsics[..., 0] * camera.intrinsics[..., 1]).rsqrt()
    radii = pixel_width[..., None] * (2 / 12**0.5) / norm
    return Rays(torch.zeros_like(through), through / norm[..., None], radii)


def image_positions(width: int, height: int, like: Tensor) -> Float[Tensor, "pixel 2"]:
    """Centres of all pixels (u + 0.5, v + 0.5), row by row."""
    u = torch.arange(width, dtype=like.dtype, device=like.device) + 0.5
    v = torch.arange(height, dtype=like.dtype, device=like.device) + 0.5
    grid_v, grid_u = torch.meshgrid(v, u, indexing="ij")
    return torch.stack([grid_u, grid_v], dim=-1).reshape(-1, 2)


def image_rays(camera: Camera) -> Rays:
    """Rays through all pixels of one camera (no batch in `camera`), as a batch of one."""
    positions = image_positions(camera.width, camera.height, camera.intrinsics)
    return pixel_rays(Camera(camera.intrinsics[None], camera.width, camera.height), positions[None])


@dataclass(frozen=True)
class CanonicalRays:
    """Rays carried into canonical units, still parametrised by the metric distance t, with their stay in the box.

    `directions` are images of unit vectors: their norm `stretch` is canonical length per metre, the factor that turns a
    canonical density into one per metre.
    """

    origins: Float[Tensor, "batch ray 3"]
    directions: Float[Tensor, "batch ray 3"]
    radii: Float[Tensor, "batch ray"]
    linear: Float[Tensor, "batch 3 3"]
    near: Float[Tensor, "batch ray"]
    far: Float[Tensor, "batch ray"]
    hit: Bool[Tensor, "batch ray"]

    @property
    def stretch(self) -> Float[Tensor, "batch ray"]:
        """||S R^T d||, canonical units per metre along the ray."""
        return self.directions.norm(dim=-1)

    @property
    def view_directions(self) -> Float[Tensor, "batch ray 3"]:
        """Unit directions in the canonical frame."""
        return torch.nn.functional.normalize(self.directions, dim=-1)


def to_canonical(rays: Rays, box: Box3D) -> CanonicalRays:
    """Car-Studio Eq. 2 applied to rays: entry to and exit from [-1, 1]^3 at metric distances `near`, `far`."""
    transform = canonical_from_camera(box)
    origins = transform_points(transform, rays.origins)
    directions = transform_directions(transform, rays.directions)
    near, far, hit = ray_cube_interval(origins, directions)
    return CanonicalRays(origins, directions, rays.radii, transform[..., :3, :3], near, far, hit)
