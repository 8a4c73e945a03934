"""Random patches of cars all around, the shape of real batches without any data."""

import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.interface import PatchBatch
from carstudio.rendering.rays import pixel_rays
from carstudio.training.batches import PixelBatch, stack_boxes


def random_batch(count: int, rays_per_patch: int, side_px: int) -> tuple[PatchBatch, PixelBatch]:
    """`count` cars seen from evenly spread azimuths, noise for pixels, rays that all hit the box."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([4.2, 1.55, 1.8])
    boxes = [orbit_box(size, azimuth_deg=20 + 360 * i / count, elevation_deg=10, distance_m=10.0) for i in range(count)]
    box: Box3D = stack_boxes(boxes)
    camera = orbit_camera(128)
    cameras = Camera(camera.intrinsics.expand(count, 4), 128, 128)
    inside = torch.rand(count, rays_per_patch, 3, generator=generator) * 1.6 - 0.8
    points = (inside * box.size[:, None] / 2) @ box.rotation.mT + box.center[:, None]
    image = torch.rand(count, 3, side_px, side_px, generator=generator)
    ids = tuple(f"random-{i}" for i in range(count))
    patches = PatchBatch(image, torch.ones(count, side_px, side_px), cameras.resize(side_px, side_px), box, ids)
    pixels = PixelBatch(
        rays=pixel_rays(cameras, cameras.project(points)),
        box=box,
        rgb=torch.rand(count, rays_per_patch, 3, generator=generator),
        alpha=(torch.rand(count, rays_per_patch, generator=generator) > 0.3).float(),
        is_known=torch.ones(count, rays_per_patch, dtype=torch.bool),
    )
    return patches, pixels
