"""A cloud of Gaussians in a car's box, traced along metric rays."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.rendering.gaussians.cloud import GaussianCloud, Splats, splats_of, widened_splats
from carstudio.rendering.gaussians.compositing import composite_hits
from carstudio.rendering.gaussians.hits import ray_hits
from carstudio.rendering.gaussians.reference import sorted_responses
from carstudio.rendering.gaussians.tiles import tile_classes
from carstudio.rendering.rays import CanonicalRays, Rays
from carstudio.rendering.volume import Rendering, Segments


@dataclass(frozen=True)
class SplattingConfig:
    """How rays meet Gaussians."""

    most: int = 32
    """Gaussians a ray may hit; those behind are left out (by then hardly any light is left)."""
    widen: bool = True
    """Widen Gaussians by the pixel's footprint, so that far and small pictures neither shimmer nor thin out."""
    is_reference: bool = False
    """Take the slow, plain path through all Gaussians."""


def trace_cloud(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> Segments:
    """Segments of the Gaussians that each ray meets, from front to back; none where a ray misses the box.

    All metric: the peak's distance along the ray, its depth, its alpha; rgb is the Gaussian's.
    """
    hits = _hits(cloud, rays, canonical, config)
    first = torch.arange(len(hits.index), device=hits.index.device)[:, None, None] * hits.rgb.shape[1]
    flat = (hits.index + first).flatten()
    colours = hits.rgb.flatten(0, 1).index_select(0, flat).unflatten(0, hits.index.shape)
    distance = (hits.t + hits.middle[..., None]) / canonical.stretch[..., None]
    alpha = hits.alpha * canonical.hit[..., None]
    return Segments(distance, distance * rays.directions[..., 2:], alpha, colours)


def render_cloud(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> Rendering:
    """What `composite` makes of `trace_cloud`'s segments, without laying out the segments' colours."""
    hits = _hits(cloud, rays, canonical, config)
    colour, sums, weights = composite_hits(hits.alpha, hits.t, hits.index, hits.rgb)
    hit = canonical.hit[..., None]
    opacity, lit = (sums * hit).unbind(-1)
    distance = (lit / opacity.clamp(min=1e-8) + hits.middle * (opacity > 0)) / canonical.stretch
    return Rendering(colour * hit, opacity, distance, distance * rays.directions[..., 2], weights * hit)


@dataclass(frozen=True)
class _Hits:
    """What rays hit (number in `rgb`); t counts from `middle`, where a ray comes nearest to the box's centre."""

    middle: Float[Tensor, "batch ray"]
    alpha: Float[Tensor, "batch ray hit"]
    t: Float[Tensor, "batch ray hit"]
    index: Int[Tensor, "batch ray hit"]
    rgb: Float[Tensor, "batch splat 3"]


def _hits(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> _Hits:
    splats = splats_seen(cloud, rays, canonical) if config.widen else splats_of(cloud)
    directions = canonical.view_directions
    middle = -(canonical.origins * directions).sum(dim=-1)
    points = canonical.origins + middle[..., None] * directions
    rgb = cloud.colour_from(canonical.origins.mean(dim=1))
    if config.is_reference:
        return _Hits(middle, *sorted_responses(splats, points, directions, -middle), rgb)
    classes = tile_classes(splats, canonical.origins, directions)
    return _Hits(middle, *ray_hits(splats, points, directions, -middle, most=config.most, classes=classes), rgb)


def splats_seen(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays) -> Splats:
    """Splats as wide as the rays' cones at them make them.

    A pixel's cone has a radius proportional to depth (camera z), the same for all pixels of a pinhole camera; where the
    cameras of a batch entry differ, the mean stands for all.
    """
    eye = canonical.origins.mean(dim=1)
    depth = ((cloud.mean - eye[:, None]) @ torch.linalg.inv(canonical.linear).mT)[..., 2]
    radius_at_one = (rays.radii / rays.directions[..., 2].clamp(min=1e-3)).mean(dim=1)
    return widened_splats(cloud, eye, footprint_variance(radius_at_one[:, None] * depth, canonical.linear))


def footprint_variance(
    radius_m: Float[Tensor, "batch splat"], linear: Float[Tensor, "batch 3 3"]
) -> Float[Tensor, "batch splat 3"]:
    """Canonical variance of a disc of that radius, r^2 / 4 on each axis (mip-NeRF Eq. 8), through A diag A^T.

    A is diag(2 / size) times a rotation, so A A^T is diagonal.
    """
    return (radius_m**2 / 4)[..., None] * (linear**2).sum(dim=-1)[:, None]
