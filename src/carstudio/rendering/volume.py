"""Volume rendering (Car-Studio Eq. 5; NeRF Eq. 3): segments along rays, composited front to back.

Segments are what every model hands out: metric, ordered, with an alpha each. Segments of several cars and of a
background merge by distance and are composited once.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

# An alpha of exactly 1 would make log(1 - alpha) infinite; behind it a millionth of the light survives, below 8 bit.
_MAX_ALPHA = 1.0 - 1e-6


@dataclass(frozen=True)
class Segments:
    """Pieces of rays from front to back: distance along the ray and depth (camera z) of their middle, alpha, colour."""

    distance_m: Float[Tensor, "batch ray segment"]
    depth_m: Float[Tensor, "batch ray segment"]
    alpha: Float[Tensor, "batch ray segment"]
    rgb: Float[Tensor, "batch ray segment 3"]


@dataclass(frozen=True)
class Rendering:
    """What rays see: premultiplied colour over black, opacity (the paper's accumulated weights), distance and depth.

    `distance_m` and `depth_m` are means over the weights; where the opacity is 0 they are 0 and mean nothing.
    """

    rgb: Float[Tensor, "batch ray 3"]
    opacity: Float[Tensor, "batch ray"]
    distance_m: Float[Tensor, "batch ray"]
    depth_m: Float[Tensor, "batch ray"]
    weights: Float[Tensor, "batch ray segment"]


def alpha_from_density(density: Float[Tensor, "*shape"], length: Float[Tensor, "*#shape"]) -> Float[Tensor, "*shape"]:
    """1 - exp(-density length): the light lost in an interval; density and length in matching units."""
    return -torch.expm1(-density * length)


def weights_from_alpha(alpha: Float[Tensor, "*ray segment"]) -> Float[Tensor, "*ray segment"]:
    """alpha_i prod_{j<i} (1 - alpha_j), in the log domain so that gradients stay finite for opaque segments."""
    log_transmitted = torch.log1p(-alpha.clamp(max=_MAX_ALPHA)).cumsum(dim=-1)
    before = torch.cat([torch.zeros_like(log_transmitted[..., :1]), log_transmitted[..., :-1]], dim=-1)
    return alpha * torch.exp(before)


def composite(segments: Segments) -> Rendering:
    """Front-to-back compositing over black; put a background behind with `over`."""
    weights = weights_from_alpha(segments.alpha)
    opacity = weights.sum(dim=-1)
    norm = opacity.clamp(min=1e-8)
    return Rendering(
        rgb=(weights[..., None] * segments.rgb).sum(dim=-2),
        opacity=opacity,
        distance_m=(weights * segments.distance_m).sum(dim=-1) / norm,
        depth_m=(weights * segments.depth_m).sum(dim=-1) / norm,
        weights=weights,
    )


def over(rendering: Rendering, background: Float[Tensor, "*#pixel 3"]) -> Float[Tensor, "batch ray 3"]:
    """The rendering in front of an opaque background colour."""
    return rendering.rgb + (1 - rendering.opacity[..., None]) * background


def merge_segments(*parts: Segments) -> Segments:
    """Segments of several objects on the same rays, sorted by distance: cars interleave with each other and the road.

    Objects whose segments overlap in distance are interleaved by the segments' middles.
    """
    distance = torch.cat([part.distance_m for part in parts], dim=-1)
    order = distance.argsort(dim=-1, stable=True)
    depth = torch.cat([part.depth_m for part in parts], dim=-1)
    alpha = torch.cat([part.alpha for part in parts], dim=-1)
    rgb = torch.cat([part.rgb for part in parts], dim=-2)
    return Segments(
        torch.gather(distance, -1, order),
        torch.gather(depth, -1, order),
        torch.gather(alpha, -1, order),
        torch.take_along_dim(rgb, order[..., None], dim=-2),
    )
