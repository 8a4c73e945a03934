"""Gaussians in place of conical frustums (mip-NeRF Eq. 7-8), mapped into the canonical frame.

A frustum between distances t0 and t1 has mean o + mu_t d and covariance var_t d d^T + var_r (I - d d^T), |d| = 1. The
canonical map is affine with linear part A, so the exact canonical Gaussian has covariance A Sigma A^T. The encoding
needs only its diagonal: var_t (A d)^2 + var_r (diag(A A^T) - (A d)^2).
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.rendering.rays import CanonicalRays

ConeMap = Literal["exact", "isotropic-as-released"]


@dataclass(frozen=True)
class Gaussians:
    """Samples along rays: mean and the diagonal of the covariance, canonical units."""

    mean: Float[Tensor, "batch ray sample 3"]
    variance: Float[Tensor, "batch ray sample 3"]


def frustum_moments(
    t0: Float[Tensor, "*shape"], t1: Float[Tensor, "*shape"], radius: Float[Tensor, "*#shape"]
) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape"], Float[Tensor, "*shape"]]:
    """Mean and variance of the distance, and variance across the axis (mip-NeRF Eq. 7, the stable form).

    `radius` is the cone's radius per unit of t.
    """
    mid, half = (t0 + t1) / 2, (t1 - t0) / 2
    denominator = (3 * mid**2 + half**2).clamp(min=1e-12)
    t_mean = mid + 2 * mid * half**2 / denominator
    t_variance = half**2 / 3 - (4 / 15) * half**4 * (12 * mid**2 - half**2) / denominator**2
    r_variance = radius**2 * (mid**2 / 4 + (5 / 12) * half**2 - (4 / 15) * half**4 / denominator)
    return t_mean, t_variance, r_variance


def canonical_gaussians(
    rays: CanonicalRays, t_edges: Float[Tensor, "batch ray edge"], cone_map: ConeMap = "exact"
) -> Gaussians:
    """The Gaussian of every interval of `t_edges` (metric distances) in the canonical frame.

    "exact" maps the metric Gaussian, A Sigma A^T. "isotropic-as-released" is the released code's shortcut: a round cone
    traced in the canonical frame, its aperture chosen so that it covers the pixel's canonical solid angle.
    """
    t0, t1 = t_edges[..., :-1], t_edges[..., 1:]
    directions = rays.directions[..., None, :]
    if cone_map == "exact":
        t_mean, t_variance, r_variance = frustum_moments(t0, t1, rays.radii[..., None])
        along = directions**2
        across = (rays.linear**2).sum(dim=-1)[:, None, None, :] - along
    else:
        stretch = rays.stretch[..., None]
        t_mean, t_variance, r_variance = frustum_moments(
            t0 * stretch, t1 * stretch, released_canonical_radius(rays)[..., None]
        )
        t_mean = t_mean / stretch
        along = rays.view_directions[..., None, :] ** 2
        across = 1 - along
    mean = rays.origins[..., None, :] + t_mean[..., None] * directions
    variance = t_variance[..., None] * along + r_variance[..., None] * across
    return Gaussians(mean, variance.clamp(min=0))


def released_canonical_radius(rays: CanonicalRays) -> Float[Tensor, "batch ray"]:
    """Radius per canonical unit of a round cone with the pixel's solid angle in the canonical frame.

    A linear map A turns the solid angle about d into |det A| / ||A d||^3 times as much; a pixel of width w covers about
    w^2 and the released renderer gives a pixel of area a the radius sqrt(a / pi).
    """
    metric_area = (rays.radii * (12**0.5 / 2)) ** 2
    area = metric_area * torch.linalg.det(rays.linear).abs()[:, None] / rays.stretch**3
    return (area / math.pi).sqrt()
