"""Rays and Gaussians, the plain way: every Gaussian on every ray, sorted by the peak of its response.

With a = x - mu for a point x of the ray and its direction d: b = d^T P a, e = d^T P d. The response exp(-(a + t d)^T P
(a + t d) / 2) peaks at t* = -b / e with exp(-(a^T P a - b^2 / e) / 2). Slow, in any precision; the yardstick of `hits`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.rendering.gaussians.cloud import Splats

FAINTEST = 1.0 / 256  # an alpha below it counts as 0, or every Gaussian would be on every ray
MAX_ALPHA = 0.999  # of one Gaussian: some light comes through, so that gradients reach what lies behind


def reach_limit(opacity: Float[Tensor, "batch splat"]) -> Float[Tensor, "batch splat"]:
    """Squared distance at which a Gaussian's alpha is the faintest that counts; negative: it never does."""
    return 2 * torch.log((opacity / FAINTEST).clamp(min=1e-12))


def responses(
    splats: Splats, points: Float[Tensor, "batch ray 3"], directions: Float[Tensor, "batch ray 3"]
) -> tuple[Float[Tensor, "batch ray splat"], Float[Tensor, "batch ray splat"]]:
    """Alpha of every Gaussian on every ray x + t d, and the t of its peak."""
    offset = points[:, :, None] - splats.mean[:, None]
    precision = splats.precision.matrix()[:, None].expand(*offset.shape, 3)
    direction = directions[:, :, None].expand_as(offset)
    across = (precision @ direction[..., None]).squeeze(-1)
    b, e = (across * offset).sum(dim=-1), (across * direction).sum(dim=-1)
    distance2 = ((precision @ offset[..., None]).squeeze(-1) * offset).sum(dim=-1) - b * b / e
    alpha = splats.opacity[:, None] * torch.exp(-distance2.clamp(min=0) / 2)
    return alpha.clamp(max=MAX_ALPHA), -b / e


def sorted_responses(
    splats: Splats,
    points: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    nearest: Float[Tensor, "batch ray"],
) -> tuple[Float[Tensor, "batch ray splat"], Float[Tensor, "batch ray splat"], Tensor]:
    """alpha, t of the peak and number from front to back; alpha is 0 where too faint or t <= `nearest`."""
    alpha, t = responses(splats, points, directions)
    alpha = alpha * ((t > nearest[..., None]) & (alpha >= FAINTEST))
    t, order = t.sort(dim=-1)
    return torch.gather(alpha, -1, order), t, order
