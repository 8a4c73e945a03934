"""Several objects and the background in one picture: segments along each ray merge by distance, composited once.

Pixels are worked on in groups that the same objects share, so that most of them need no merging at all; the result is
that of merging all segments on all rays (Car-Studio Eq. 5 over the union of the cars' samples).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.models.interface import CategoryModel, Latents, tiles_that_hit, window_of
from carstudio.rendering.rays import image_positions, image_rays, pixel_rays, to_canonical
from carstudio.rendering.volume import Segments, weights_from_alpha

RIM_SAMPLES = 6  # per side, of a pixel at the rim of a box
FAINTEST = 1 / 512  # a share of a pixel that moves no 8-bit value by more than half a step


@dataclass(frozen=True)
class TracedObject:
    """An object as rays of a picture meet it. `pixels` are row-major numbers, each at most once."""

    pixels: Int[Tensor, " ray"]
    segments: Segments  # a batch of one


@dataclass(frozen=True)
class ObjectLayer:
    """What is seen of one object, on the pixels where there is anything of it.

    `weight` is its visible share of the pixel, `alone` its opacity if nothing were before it, `rgb` is premultiplied
    by the weight, `depth_m` (camera z) is the mean over the visible part.
    """

    pixels: Int[Tensor, " pixel"]
    weight: Float[Tensor, " pixel"]
    alone: Float[Tensor, " pixel"]
    rgb: Float[Tensor, "pixel 3"]
    depth_m: Float[Tensor, " pixel"]


@torch.no_grad()
def trace_object(model: CategoryModel, latents: Latents, box: Box3D, camera: Camera) -> TracedObject:
    """The segments of a car on all pixels that its box (a batch of one) covers, if only in part.

    A model knows nothing outside its box, so there the car is cut off, and hard if rays went through pixels' centres
    alone. A pixel at the box's rim is looked at where the box covers it, and its segments count for that share of it.
    """
    x, y, width, height = window_of(box, camera)
    if width == 0 or height == 0:
        return _nothing(camera)
    seen = camera.crop(x, y, width, height)
    wide_positions, wide_share = _coverage(box, seen.crop(-1, -1, width + 2, height + 2))  # the rim needs neighbours
    inner = torch.zeros(height + 2, width + 2, dtype=torch.bool)
    inner[1:-1, 1:-1] = True
    positions, share = wide_positions[inner.flatten()] - 1, wide_share[inner.flatten()]
    tiles = tiles_that_hit((share > 0).view(height, width), model.tile_px)
    if len(tiles) == 0:
        return _nothing(camera)
    rays = pixel_rays(_one(seen), positions[None])
    parts = [model.trace(rays.select(rows), latents, box) for rows in tiles.split(model.chunk_rays)]
    segments = _joined(parts)
    # Tiles at the window's edge repeat pixels and hold some that miss the box: each covered pixel once.
    first = torch.full((width * height,), -1, dtype=torch.long)
    first[tiles] = torch.arange(len(tiles))
    rows = first[(share > 0) & (first >= 0)]
    pixel = tiles[rows]
    numbers = (pixel // width + y) * camera.width + pixel % width + x
    return TracedObject(numbers, partial_segments(select_rays(segments, rows), share[pixel]))


def _one(camera: Camera) -> Camera:
    return Camera(camera.intrinsics[None], camera.width, camera.height)


def _coverage(box: Box3D, camera: Camera) -> tuple[Float[Tensor, "pixel 2"], Float[Tensor, " pixel"]]:
    """Share of each pixel that the box covers, and the middle (px) of that part; the pixel's centre where it is none.

    Only pixels at the rim, next to ones whose centre is covered or not, are looked at closely.
    """
    positions = image_positions(camera.width, camera.height, camera.intrinsics)
    hit = to_canonical(image_rays(camera), box).hit[0]
    share = hit.to(positions.dtype)
    near = torch.nn.functional.max_pool2d(share.view(1, 1, camera.height, camera.width), 3, 1, 1)
    far = -torch.nn.functional.max_pool2d(-share.view(1, 1, camera.height, camera.width), 3, 1, 1)
    rim = (near != far).flatten().nonzero()[:, 0]
    if len(rim):
        fine = image_positions(RIM_SAMPLES, RIM_SAMPLES, positions) / RIM_SAMPLES - 0.5
        samples = positions[rim, None] + fine
        inside = to_canonical(pixel_rays(_one(camera), samples.flatten(0, 1)[None]), box).hit[0].view(len(rim), -1, 1)
        count = inside.sum(dim=1)
        share[rim] = count[:, 0] / len(fine)
        middle = (samples * inside).sum(dim=1) / count.clamp(min=1)
        positions[rim] = torch.where(count > 0, middle, positions[rim])
    return positions, share


def partial_segments(segments: Segments, share: Float[Tensor, " ray"]) -> Segments:
    """Segments that fill only a share of their pixel: every weight times the share, written as alphas again."""
    rim = (share < 1).nonzero()[:, 0]
    if len(rim) == 0:
        return segments
    weights = weights_from_alpha(segments.alpha[:, rim]) * share[rim, None]
    left = 1 - (weights.cumsum(dim=-1) - weights)
    alpha = segments.alpha.index_copy(1, rim, (weights / left.clamp(min=1e-6)).clamp(max=1))
    return Segments(segments.distance_m, segments.depth_m, alpha, segments.rgb)


def _nothing(camera: Camera) -> TracedObject:
    none = camera.intrinsics.new_zeros(1, 0, 1)
    segments = Segments(none, none, none, none[..., None].expand(1, 0, 1, 3))
    return TracedObject(torch.zeros(0, dtype=torch.long), segments)


def _joined(parts: Sequence[Segments]) -> Segments:
    if len(parts) == 1:
        return parts[0]
    most = max(part.alpha.shape[-1] for part in parts)

    def padded(part: Segments) -> Segments:
        more = most - part.alpha.shape[-1]
        grow = torch.nn.functional.pad
        return Segments(
            grow(part.distance_m, (0, more)),
            grow(part.depth_m, (0, more)),
            grow(part.alpha, (0, more)),
            grow(part.rgb, (0, 0, 0, more)),
        )

    wide = [padded(part) for part in parts]
    return Segments(*(torch.cat([getattr(part, name) for part in wide], dim=1) for name in _FIELDS))


_FIELDS = ("distance_m", "depth_m", "alpha", "rgb")


def select_rays(segments: Segments, rows: Tensor) -> Segments:
    """Some of the rays."""
    return Segments(*(getattr(segments, name)[:, rows] for name in _FIELDS))


def merge_layers(
    objects: Sequence[TracedObject], background_m: Float[Tensor, " all_pixels"]
) -> tuple[ObjectLayer, ...]:
    """The visible part of every object before an opaque background.

    `background_m` is its distance along each pixel's ray, inf where there is none.
    The order of the objects matters only where segments of two lie at exactly the same distance.
    """
    count = len(background_m)
    row_of = torch.full((len(objects), count), -1, dtype=torch.long)
    for number, traced in enumerate(objects):
        row_of[number, traced.pixels] = torch.arange(len(traced.pixels))
    parts: list[list[ObjectLayer]] = [[] for _ in objects]
    for members, pixels in _groups(row_of >= 0):
        chosen = [select_rays(objects[i].segments, row_of[i, pixels]) for i in members]
        for i, layer in zip(members, _composited(chosen, pixels, background_m[pixels]), strict=True):
            parts[i].append(layer)
    return tuple(_joined_layer(part) for part in parts)


def _groups(has: Tensor) -> list[tuple[list[int], Tensor]]:
    """(objects, pixels) for each set of objects that some pixels share; pixels without any are in none."""
    touched = has.any(dim=0).nonzero()[:, 0]
    if len(touched) == 0:
        return []
    keys = np.ascontiguousarray(np.packbits(has[:, touched].numpy(), axis=0).T)
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    group_of = torch.from_numpy(group.reshape(-1))
    return [
        (has[:, touched[int(first[i])]].nonzero()[:, 0].tolist(), touched[group_of == i]) for i in range(len(first))
    ]


def _composited(
    members: Sequence[Segments], pixels: Tensor, background_m: Float[Tensor, " pixel"]
) -> list[ObjectLayer]:
    wall = background_m[None, :, None]
    distance = torch.cat([*(part.distance_m for part in members), wall], dim=-1)
    alpha = torch.cat([*(part.alpha for part in members), torch.ones_like(wall)], dim=-1)
    order = distance.argsort(dim=-1, stable=True)
    sorted_weights = weights_from_alpha(torch.gather(alpha, -1, order))
    weights = torch.zeros_like(alpha).scatter(-1, order, sorted_weights)
    layers, start = [], 0
    for part in members:
        share = weights[0, :, start : start + part.alpha.shape[-1]]
        start += part.alpha.shape[-1]
        weight = share.sum(dim=-1)
        layers.append(
            ObjectLayer(
                pixels,
                weight,
                weights_from_alpha(part.alpha[0]).sum(dim=-1),
                (share[..., None] * part.rgb[0]).sum(dim=-2),
                (share * part.depth_m[0]).sum(dim=-1) / weight.clamp(min=1e-8),
            )
        )
    return layers


def _joined_layer(parts: Sequence[ObjectLayer]) -> ObjectLayer:
    if not parts:
        none = torch.zeros(0)
        return ObjectLayer(torch.zeros(0, dtype=torch.long), none, none, torch.zeros(0, 3), none)
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in ObjectLayer.__dataclass_fields__}
    return ObjectLayer(**joined)


def bands(camera: Camera, rows: int) -> list[tuple[int, Camera]]:
    """The picture in strips of `rows` rows (first row, camera), which bounds the memory that segments take."""
    starts = range(0, camera.height, rows)
    return [(y, camera.crop(0, y, camera.width, min(rows, camera.height - y))) for y in starts]


def ray_lengths(camera: Camera) -> Float[Tensor, " pixel"]:
    """Distance along the ray per metre of depth, for each pixel."""
    return 1 / image_rays(camera).directions[0, :, 2]
