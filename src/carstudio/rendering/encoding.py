"""Positional encodings: of points (NeRF Eq. 4) and of Gaussians (mip-NeRF Eq. 13-14).

The layout is [sin of frequency 0 of x, y, z; frequency 1; ...; then all cosines].
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def octaves(num_frequencies: int, like: Tensor) -> Float[Tensor, " frequency"]:
    """2^0, 2^1, ... 2^(n-1), rad per canonical unit."""
    return 2.0 ** torch.arange(num_frequencies, dtype=like.dtype, device=like.device)


def released_frequencies(num_frequencies: int, like: Tensor) -> Float[Tensor, " frequency"]:
    """As released: 2 pi 2^linspace(0, n, n)."""
    exponents = torch.linspace(0.0, float(num_frequencies), num_frequencies, dtype=like.dtype, device=like.device)
    return 2 * math.pi * 2.0**exponents


def positional_encoding(
    points: Float[Tensor, "*shape 3"], frequencies: Float[Tensor, " frequency"]
) -> Float[Tensor, "*shape feature"]:
    """sin(f x), cos(f x) for every frequency and axis."""
    phase = (points[..., None, :] * frequencies[:, None]).flatten(-2)
    return torch.cat([phase.sin(), phase.cos()], dim=-1)


def integrated_positional_encoding(
    mean: Float[Tensor, "*shape 3"],
    variance: Float[Tensor, "*shape 3"],
    frequencies: Float[Tensor, " frequency"],
    variance_frequencies: Float[Tensor, " frequency"] | None = None,
) -> Float[Tensor, "*shape feature"]:
    """Expected sin(f x), cos(f x) of Gaussians: the plain encoding times exp(-f^2 variance / 2) (mip-NeRF Eq. 14).

    `variance_frequencies` replaces f in the damping only; the released code forgets the factor 2 pi there.
    """
    damping_frequencies = frequencies if variance_frequencies is None else variance_frequencies
    damping = torch.exp(-0.5 * (variance[..., None, :] * damping_frequencies[:, None] ** 2).flatten(-2))
    phase = (mean[..., None, :] * frequencies[:, None]).flatten(-2)
    return torch.cat([phase.sin() * damping, phase.cos() * damping], dim=-1)
