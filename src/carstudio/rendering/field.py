"""Tracing a radiance field through the car's box: coarse pass, resampling, fine pass (mip-NeRF section 3.2).

The field arrives as a function of Gaussians and view directions in the canonical frame; its density is per canonical
unit, and `CanonicalRays.stretch` makes it metric.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.rendering.cones import ConeMap, Gaussians, canonical_gaussians
from carstudio.rendering.rays import CanonicalRays, Rays
from carstudio.rendering.sampling import blur_weights, resampled_edges, stratified_edges
from carstudio.rendering.volume import Segments, alpha_from_density, weights_from_alpha

# field(gaussians, view directions) -> density per canonical unit, rgb in [0, 1]
Field = Callable[
    [Gaussians, Float[Tensor, "batch ray 3"]],
    tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]],
]


@dataclass(frozen=True)
class SamplingConfig:
    """How many samples a ray gets between entry to and exit from the box."""

    coarse: int = 128
    """Evenly spread intervals of the first pass (Car-NeRF: 128)."""
    fine: int = 128
    """Intervals of the second pass, placed by the first one's weights; 0: one pass only (Car-NeRF: 128)."""
    cone_map: ConeMap = "exact"
    """How the cone is carried into the canonical frame."""


def trace_field(
    field: Field,
    rays: Rays,
    canonical: CanonicalRays,
    config: SamplingConfig,
    generator: torch.Generator | None = None,
) -> tuple[Segments, ...]:
    """Segments of the coarse and (when asked for) the fine pass, the last being the result.

    Rays that miss the box give segments of alpha 0 at distance 0.
    """
    edges = stratified_edges(canonical.near, canonical.far, config.coarse, generator)
    levels = [_query(field, rays, canonical, edges, config.cone_map)]
    if config.fine:
        weights = blur_weights(weights_from_alpha(levels[0].alpha.detach()))
        edges = resampled_edges(edges, weights, config.fine, generator)
        levels.append(_query(field, rays, canonical, edges, config.cone_map))
    return tuple(levels)


def _query(
    field: Field, rays: Rays, canonical: CanonicalRays, edges: Float[Tensor, "batch ray edge"], cone_map: ConeMap
) -> Segments:
    gaussians = canonical_gaussians(canonical, edges, cone_map)
    density, rgb = field(gaussians, canonical.view_directions)
    length = (edges[..., 1:] - edges[..., :-1]) * canonical.stretch[..., None]
    distance = (edges[..., 1:] + edges[..., :-1]) / 2
    return Segments(distance, distance * rays.directions[..., 2:], alpha_from_density(density, length), rgb)
