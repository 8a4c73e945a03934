"""A cloud of Gaussians in a car's box, traced along metric rays."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.rendering.gaussians.cloud import GaussianCloud, Splats, splats_of, widened_splats
from carstudio.rendering.gaussians.compositing import composite_hits
from carstudio.rendering.gaussians.hits import hits_of_features
from carstudio.rendering.gaussians.reference import sorted_responses
from carstudio.rendering.gaussians.tiles import encounter
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
    shape = (*canonical.hit.shape, hits.alpha.shape[-1])
    distance = (hits.t.reshape(shape) + hits.middle[..., None]) / canonical.stretch[..., None]
    groups = torch.arange(len(hits.index), device=hits.index.device)[:, None, None]
    flat = (hits.index + hits.rgb.shape[1] * groups).flatten()
    rgb = hits.rgb.flatten(0, 1).index_select(0, flat).unflatten(0, shape)
    alpha = hits.alpha.reshape(shape) * canonical.hit[..., None]
    return Segments(distance, distance * rays.directions[..., 2:], alpha, rgb)


def render_cloud(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> Rendering:
    """What `composite` makes of `trace_cloud`'s segments, without laying out the segments' colours."""
    hits = _hits(cloud, rays, canonical, config)
    rgb, sums, weights = composite_hits(hits.alpha, hits.t, hits.index, hits.rgb)
    shape, hit = canonical.hit.shape, canonical.hit[..., None]
    rgb, sums, weights = rgb.reshape(*shape, 3) * hit, sums.reshape(*shape, 2) * hit, weights.reshape(*shape, -1) * hit
    opacity = sums[..., 0]
    distance = (sums[..., 1] / opacity.clamp(min=1e-8) + hits.middle * (opacity > 0)) / canonical.stretch
    return Rendering(rgb, opacity, distance, distance * rays.directions[..., 2], weights)


@dataclass(frozen=True)
class _Hits:
    """Groups of rays and what they hit (number in `rgb`); t counts from the ray's point nearest the box's centre."""

    alpha: Float[Tensor, "group ray hit"]
    t: Float[Tensor, "group ray hit"]
    index: Int[Tensor, "group ray hit"]
    rgb: Float[Tensor, "group splat 3"]
    middle: Float[Tensor, "batch all_rays"]


def _hits(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> _Hits:
    splats = splats_seen(cloud, rays, canonical) if config.widen else splats_of(cloud)
    directions = canonical.view_directions
    middle = -(canonical.origins * directions).sum(dim=-1)
    points = canonical.origins + middle[..., None] * directions
    rgb = cloud.colour_from(canonical.origins.mean(dim=1))
    if config.is_reference:
        return _Hits(*sorted_responses(splats, points, directions, -middle), rgb, middle)
    met = encounter(splats, rgb, points, directions, -middle)
    alpha, t, index = hits_of_features(met.coefficients, met.opacity, met.features, met.nearest, most=config.most)
    return _Hits(alpha, t, index, met.rgb, middle)


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
