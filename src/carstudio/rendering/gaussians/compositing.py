"""Hits composited front to back without ever laying out their colours: what `volume.composite` gives, in less time.

w_i = alpha_i prod_{j<i} (1 - alpha_j). Colours are looked up channel by channel, so that a hit takes one number at a
time. With u_i = dL/dw_i the slope is dL/dalpha_i = (w_i u_i / alpha_i) - (sum_{j>i} w_j u_j) / (1 - alpha_i).
"""

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.rendering.gaussians.symmetric import planes


def composite_hits(
    alpha: Float[Tensor, "batch ray hit"],
    t: Float[Tensor, "batch ray hit"],
    index: Int[Tensor, "batch ray hit"],
    rgb: Float[Tensor, "batch splat 3"],
) -> tuple[Float[Tensor, "batch ray 3"], Float[Tensor, "batch ray 2"], Float[Tensor, "batch ray hit"]]:
    """Colour over black; opacity and weighted sum of t; the weights (without gradient)."""
    colour, sums, weights = _CompositeHits.apply(alpha, t, index, rgb)
    return colour, sums, weights


class _CompositeHits(torch.autograd.Function):
    """See `composite_hits`."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, t: Tensor, index: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weights = torch.log1p(-alpha).cumsum_(dim=-1).exp_().roll(1, dims=-1)  # what passes each hit, at the next
        weights[..., 0] = 1
        weights.mul_(alpha)
        place = _places(index, rgb.shape[1])
        shown = [(_look_up(channel, place, index.shape).mul_(weights)).sum(dim=-1) for channel in planes(rgb)]
        sums = torch.stack([weights.sum(dim=-1), (weights * t).sum(dim=-1)], dim=-1)
        ctx.save_for_backward(alpha, t, index, rgb, weights)
        ctx.mark_non_differentiable(weights)
        return torch.stack(shown, dim=-1), sums, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        alpha, t, index, rgb, weights = ctx.saved_tensors
        to_colour, to_sums = gradients[0], gradients[1]
        place = _places(index, rgb.shape[1])
        slope = to_sums[..., 1:] * t + to_sums[..., :1]
        to_rgb = rgb.new_zeros(3, rgb.shape[0] * rgb.shape[1])
        for into, own, given in zip(to_rgb, planes(rgb), planes(to_colour), strict=True):
            slope.addcmul_(_look_up(own, place, index.shape), given[..., None])
            into.scatter_add_(0, place, (weights * given[..., None]).flatten())
        lit = weights * slope
        behind = lit.sum(dim=-1, keepdim=True) - torch.cumsum(lit, dim=-1)
        through = weights / alpha.clamp(min=1e-12)  # what reaches the hit; where alpha is 0 nothing asks for it
        to_alpha = through * slope - behind / (1 - alpha)
        return to_alpha, weights * to_sums[..., 1:], None, to_rgb.T.reshape(rgb.shape)


def _places(index: Int[Tensor, "batch ray hit"], num_splats: int) -> Int[Tensor, " all_hits"]:
    """Where hits' Gaussians are when those of all entries stand in one row."""
    first = torch.arange(0, len(index) * num_splats, num_splats, device=index.device)
    return (index + first[:, None, None]).flatten()


def _look_up(values: Tensor, place: Tensor, shape: torch.Size) -> Tensor:
    """One number of each Gaussian, for each hit."""
    return values.flatten().index_select(0, place).view(shape)
