"""Where to sample along a ray: evenly between entry and exit, then where the first pass found something.

`t_edges` are the n + 1 fence posts of n intervals, metric distances, ascending. With `generator=None` the result is
deterministic (evaluation); a generator jitters it (training).
"""

import torch
from jaxtyping import Float
from torch import Tensor


def stratified_edges(
    near: Float[Tensor, "*ray"], far: Float[Tensor, "*ray"], num_samples: int, generator: torch.Generator | None = None
) -> Float[Tensor, "*ray edge"]:
    """num_samples + 1 edges from `near` to `far`; jittered edges move within half an interval to each side.

    The ends are never moved beyond near and far (mip-NeRF's stratified sampling of fence posts).
    """
    fractions = torch.linspace(0.0, 1.0, num_samples + 1, dtype=near.dtype, device=near.device)
    if generator is not None:
        midpoints = (fractions[1:] + fractions[:-1]) / 2
        low = torch.cat([fractions[:1], midpoints])
        high = torch.cat([midpoints, fractions[-1:]])
        noise = torch.rand(
            (*near.shape, num_samples + 1), generator=generator, dtype=near.dtype, device=generator.device
        )
        fractions = low + (high - low) * noise.to(near.device)
    return near[..., None] + (far - near)[..., None] * fractions


def blur_weights(weights: Float[Tensor, "*ray sample"], padding: float = 0.01) -> Float[Tensor, "*ray sample"]:
    """mip-NeRF section 3.2: a two-tap max then a two-tap mean widen the histogram, `padding` keeps it above zero."""
    padded = torch.cat([weights[..., :1], weights, weights[..., -1:]], dim=-1)
    larger = torch.maximum(padded[..., :-1], padded[..., 1:])
    return (larger[..., :-1] + larger[..., 1:]) / 2 + padding


def resampled_edges(
    t_edges: Float[Tensor, "*ray edge"],
    weights: Float[Tensor, "*ray sample"],
    num_samples: int,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "*ray new_edge"]:
    """num_samples + 1 edges drawn from the piecewise constant density of `weights` over `t_edges` by inverse CDF.

    No gradient flows through the places (mip-NeRF section 3.2). Deterministic: the quantiles i / n, ends included.
    """
    with torch.no_grad():
        density = weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-12)
        cdf = torch.cat([torch.zeros_like(density[..., :1]), density.cumsum(dim=-1)], dim=-1).clamp(max=1.0)
        cdf[..., -1] = 1.0
        count = num_samples + 1
        start = torch.arange(count, dtype=t_edges.dtype, device=t_edges.device)
        if generator is None:
            quantiles = (start / num_samples).expand(*t_edges.shape[:-1], count).contiguous()
        else:
            shape = (*t_edges.shape[:-1], count)
            noise = torch.rand(shape, generator=generator, dtype=t_edges.dtype, device=generator.device)
            quantiles = (start + noise.to(t_edges.device)) / count
        right = torch.searchsorted(cdf, quantiles, right=True).clamp(1, cdf.shape[-1] - 1)
        cdf_low, cdf_high = torch.gather(cdf, -1, right - 1), torch.gather(cdf, -1, right)
        t_low, t_high = torch.gather(t_edges, -1, right - 1), torch.gather(t_edges, -1, right)
        share = (quantiles - cdf_low) / (cdf_high - cdf_low).clamp(min=1e-12)
        return t_low + (t_high - t_low) * share.clamp(0, 1)
