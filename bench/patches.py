"""Random patches of cars all around, the shape of real batches without any data."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.interface import PatchBatch
from carstudio.rendering.gaussians.tiles import TILE
from carstudio.rendering.rays import pixel_rays
from carstudio.training.batches import PixelBatch, stack_boxes


def random_batch(
    count: int, rays_per_patch: int, side_px: int, *, in_tiles: bool = False
) -> tuple[PatchBatch, PixelBatch]:
    """`count` cars seen from evenly spread azimuths, noise for pixels, rays that all hit the box.

    `in_tiles` has rays that lie together follow each other, 16 at a time, as those drawn from the cells of a photo do.
    """
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([4.2, 1.55, 1.8])
    boxes = [orbit_box(size, azimuth_deg=20 + 360 * i / count, elevation_deg=10, distance_m=10.0) for i in range(count)]
    box: Box3D = stack_boxes(boxes)
    camera = orbit_camera(128)
    cameras = Camera(camera.intrinsics.expand(count, 4), 128, 128)
    inside = torch.rand(count, rays_per_patch, 3, generator=generator) * 1.6 - 0.8
    points = (inside * box.size[:, None] / 2) @ box.rotation.mT + box.center[:, None]
    places = cameras.project(points)
    if in_tiles:
        places = by_tiles(places)
    image = torch.rand(count, 3, side_px, side_px, generator=generator)
    ids = tuple(f"random-{i}" for i in range(count))
    patches = PatchBatch(image, torch.ones(count, side_px, side_px), cameras.resize(side_px, side_px), box, ids)
    pixels = PixelBatch(
        rays=pixel_rays(cameras, places),
        box=box,
        rgb=torch.rand(count, rays_per_patch, 3, generator=generator),
        alpha=(torch.rand(count, rays_per_patch, generator=generator) > 0.3).float(),
        is_known=torch.ones(count, rays_per_patch, dtype=torch.bool),
    )
    return patches, pixels


def by_tiles(places: Float[Tensor, "car ray 2"]) -> Float[Tensor, "car ray 2"]:
    """The same places in n x n tiles of 16, strip by strip from above, those of a strip from the left.

    As they are where there are not as many.
    """
    strips = math.isqrt(places.shape[1] // TILE)
    if strips * strips * TILE != places.shape[1]:
        return places
    for axis, parts in ((1, 1), (0, strips)):
        rows = places.unflatten(1, (parts, -1))
        order = rows[..., axis].argsort(dim=-1)
        places = rows.gather(2, order[..., None].expand_as(rows)).flatten(1, 2)
    return places
