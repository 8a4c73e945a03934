"""A cloud of Gaussians in a car's box, traced along metric rays."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from carstudio.rendering.gaussians.cloud import GaussianCloud, Splats, splats_of, widened_splats
from carstudio.rendering.gaussians.compositing import composite_hits
from carstudio.rendering.gaussians.hits import REACH, hits_of_features
from carstudio.rendering.gaussians.reference import sorted_responses
from carstudio.rendering.gaussians.tiles import TILE, encounter
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
    middle, met = _hits(cloud, rays, canonical, config)
    colours = []
    for hits in met:
        first = torch.arange(len(hits.index), device=hits.index.device)[:, None, None] * hits.rgb.shape[1]
        flat = (hits.index + first).flatten()
        colours.append(hits.rgb.flatten(0, 1).index_select(0, flat).unflatten(0, hits.index.shape))
    t = _together(met, [hits.t for hits in met], middle.shape, beyond=REACH)
    distance = (t + middle[..., None]) / canonical.stretch[..., None]
    alpha = _together(met, [hits.alpha for hits in met], middle.shape) * canonical.hit[..., None]
    return Segments(distance, distance * rays.directions[..., 2:], alpha, _together(met, colours, middle.shape))


def render_cloud(cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig) -> Rendering:
    """What `composite` makes of `trace_cloud`'s segments, without laying out the segments' colours."""
    middle, met = _hits(cloud, rays, canonical, config)
    composites = [composite_hits(hits.alpha, hits.t, hits.index, hits.rgb) for hits in met]
    shown = [torch.cat([rgb, sums], dim=-1) for rgb, sums, _ in composites]
    hit = canonical.hit[..., None]
    rgb, opacity, lit = (_together(met, shown, middle.shape) * hit).split([3, 1, 1], dim=-1)
    weights = _together(met, [own for *_, own in composites], middle.shape) * hit
    opacity = opacity.squeeze(-1)
    distance = (lit.squeeze(-1) / opacity.clamp(min=1e-8) + middle * (opacity > 0)) / canonical.stretch
    return Rendering(rgb, opacity, distance, distance * rays.directions[..., 2], weights)


@dataclass(frozen=True)
class _Hits:
    """Groups of rays and what they hit (number in `rgb`); t counts from the ray's point nearest the box's centre."""

    alpha: Float[Tensor, "group ray hit"]
    t: Float[Tensor, "group ray hit"]
    index: Int[Tensor, "group ray hit"]
    rgb: Float[Tensor, "group splat 3"]
    groups: Int[Tensor, " group"] | None = None


def _hits(
    cloud: GaussianCloud, rays: Rays, canonical: CanonicalRays, config: SplattingConfig
) -> tuple[Float[Tensor, "batch all_rays"], list[_Hits]]:
    """Where each ray comes nearest to the box's centre, and what groups of rays hit."""
    splats = splats_seen(cloud, rays, canonical) if config.widen else splats_of(cloud)
    directions = canonical.view_directions
    middle = -(canonical.origins * directions).sum(dim=-1)
    points = canonical.origins + middle[..., None] * directions
    rgb = cloud.colour_from(canonical.origins.mean(dim=1))
    if config.is_reference:
        return middle, [_Hits(*sorted_responses(splats, points, directions, -middle), rgb)]
    found = []
    for met in encounter(splats, rgb, points, directions, -middle):
        hits = hits_of_features(met.coefficients, met.opacity, met.features, met.nearest, most=config.most)
        found.append(_Hits(*hits, met.rgb, met.groups))
    return middle, found


def _together(
    met: list[_Hits], parts: list[Tensor], shape: torch.Size, beyond: float = 0.0
) -> Float[Tensor, "batch all_rays *rest"]:
    """Values of groups of rays (group ray ...) put where the rays are.

    Rays that met nothing, and places for hits that others have more of, get `beyond`.
    """
    if met[0].groups is None:
        return parts[0].reshape(*shape, *parts[0].shape[2:])
    rest = tuple(max(sizes) for sizes in zip(*(part.shape[2:] for part in parts), strict=True))
    whole = parts[0].new_full((shape.numel() // TILE, TILE, *rest), beyond)
    for hits, part in zip(met, parts, strict=True):
        assert hits.groups is not None
        missing = rest[0] - part.shape[2]
        own = pad(part, (*(0, 0) * (part.ndim - 3), 0, missing), value=beyond) if missing else part
        whole = whole.index_copy(0, hits.groups, own)
    return whole.view(*shape, *rest)


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
