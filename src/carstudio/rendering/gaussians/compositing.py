"""Hits composited front to back without ever laying out their colours: what `volume.composite` gives, in less time.

w_i = alpha_i prod_{j<i} (1 - alpha_j). Spread over all Gaussians the weights make colour one matrix product. With
u_i = dL/dw_i the slope is dL/dalpha_i = (w_i u_i / alpha_i) - (sum_{j>i} w_j u_j) / (1 - alpha_i).
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

_CHUNK = {"cpu": 2**17, "other": 2**26}  # spread weights at a time: on a CPU they fit the cache


def composite_hits(
    alpha: Float[Tensor, "batch ray hit"],
    t: Float[Tensor, "batch ray hit"],
    index: Int[Tensor, "batch ray hit"],
    rgb: Float[Tensor, "batch splat 3"],
) -> tuple[Float[Tensor, "batch ray 3"], Float[Tensor, "batch ray 2"], Float[Tensor, "batch ray hit"]]:
    """Colour over black; opacity and weighted sum of t; the weights (without gradient).

    Each Gaussian occurs once in a ray's `index`, but for places of alpha 0.
    """
    colour, sums, weights = _CompositeHits.apply(alpha, t, index, rgb)
    return colour, sums, weights


class _CompositeHits(torch.autograd.Function):
    """See `composite_hits`."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, t: Tensor, index: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weights = torch.log1p(-alpha).cumsum_(dim=-1).exp_().roll(1, dims=-1)  # what passes each hit, at the next
        weights[..., 0] = 1
        weights.mul_(alpha)
        colour = torch.empty(*alpha.shape[:2], 3, dtype=rgb.dtype, device=rgb.device)
        for rows in _rows(alpha, rgb.shape[1]):
            colour[rows] = _spread(weights[rows], index[rows], rgb.shape[1]) @ rgb[rows]
        sums = torch.stack([weights.sum(dim=-1), (weights * t).sum(dim=-1)], dim=-1)
        ctx.save_for_backward(alpha, t, index, rgb, weights)
        ctx.mark_non_differentiable(weights)
        return colour, sums, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        alpha, t, index, rgb, weights = ctx.saved_tensors
        to_colour, to_sums = gradients[0], gradients[1]
        slope = torch.empty_like(alpha)
        to_rgb = torch.empty_like(rgb)
        for rows in _rows(alpha, rgb.shape[1]):
            to_rgb[rows] = _spread(weights[rows], index[rows], rgb.shape[1]).mT @ to_colour[rows]
            slope[rows] = torch.gather(to_colour[rows] @ rgb[rows].mT, -1, index[rows])
        slope.add_(to_sums[..., :1]).addcmul_(to_sums[..., 1:], t)
        lit = weights * slope
        behind = lit.sum(dim=-1, keepdim=True) - torch.cumsum(lit, dim=-1)
        through = weights / alpha.clamp(min=1e-12)  # what reaches the hit; where alpha is 0 nothing asks for it
        to_alpha = through * slope - behind / (1 - alpha)
        return to_alpha, weights * to_sums[..., 1:], None, to_rgb


def _rows(alpha: Tensor, num_splats: int) -> list[slice]:
    size = _CHUNK["cpu" if alpha.device.type == "cpu" else "other"]
    rows = max(1, size // (alpha.shape[1] * num_splats))
    return [slice(first, first + rows) for first in range(0, len(alpha), rows)]


def _spread(values: Tensor, index: Tensor, num_splats: int) -> Tensor:
    """(batch, ray, splat) of hits' values, 0 elsewhere."""
    dense = torch.zeros(*values.shape[:2], num_splats, dtype=values.dtype, device=values.device)
    return dense.scatter_add_(-1, index, values)
