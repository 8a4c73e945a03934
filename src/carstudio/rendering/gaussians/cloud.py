"""A cloud of rotated 3-D Gaussians in the canonical frame, and what a pixel's cone makes of it.

Notation: mu mean, s scales, R rotation, Sigma = R diag(s^2) R^T covariance, P = Sigma^-1 precision, o opacity.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.rendering.gaussians.symmetric import Planes, Symmetric3, dot, planes, planes3

Numbers = TypeVar("Numbers", Tensor, np.ndarray)


@dataclass(frozen=True)
class GaussianCloud:
    """One car per batch entry: canonical means, log scales, rotations (w, x, y, z), opacity and rgb in [0, 1]."""

    mean: Float[Tensor, "batch splat 3"]
    log_scale: Float[Tensor, "batch splat 3"]
    quaternion: Float[Tensor, "batch splat 4"]
    opacity: Float[Tensor, "batch splat"]
    rgb: Float[Tensor, "batch splat 3"]
    tint: Float[Tensor, "batch splat 3 3"] | None = None
    """Change of each channel with the line of sight (canonical unit vector), degree 1; or none."""
    light: Float[Tensor, "batch 9 3"] | None = None
    """Logarithm of a factor per channel on all colours, by `light_terms` of the direction to the camera; or none."""

    def colour_from(self, eye: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch splat 3"]:
        """What a camera there (canonical) sees: rgb, tinted by the direction from which each Gaussian is seen, all
        brighter or darker by where the camera is.
        """
        colour = self.rgb
        if self.tint is not None:
            sight = torch.nn.functional.normalize(self.mean.detach() - eye[:, None], dim=-1)
            colour = (colour + (self.tint @ sight[..., None]).squeeze(-1)).clamp(0, 1)
        if self.light is not None:
            terms = torch.stack(light_terms(*torch.nn.functional.normalize(eye, dim=-1).unbind(-1)), dim=-1)
            colour = (colour * torch.exp(terms[:, None] @ self.light)).clamp(max=1)
        return colour

    def covariance(self) -> Symmetric3:
        """R diag(s^2) R^T, of quaternions of any length."""
        w, x, y, z = planes(self.quaternion)
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        wx, wy, wz = w * x, w * y, w * z
        twice = 2 / (w * w + xx + yy + zz)
        a, b, c = planes3(torch.exp(self.log_scale))
        a2, b2, c2 = twice * a, twice * b, twice * c
        first: Planes = (a - (yy + zz) * a2, (xy - wz) * b2, (xz + wy) * c2)  # rows of R diag(s)
        second: Planes = ((xy + wz) * a2, b - (xx + zz) * b2, (yz - wx) * c2)
        third: Planes = ((xz - wy) * a2, (yz + wx) * b2, c - (xx + yy) * c2)
        rows = ((first, first), (first, second), (first, third), (second, second), (second, third), (third, third))
        return Symmetric3(*(dot(row, column) for row, column in rows))

    def mirrored(self) -> "GaussianCloud":
        """The cloud on the car's other side (z negated): N R N with N = diag(1, 1, -1) turns (w, x, y, z)."""
        return GaussianCloud(
            self.mean * self.mean.new_tensor([1.0, 1.0, -1.0]),
            self.log_scale,
            self.quaternion * self.quaternion.new_tensor([1.0, -1.0, -1.0, 1.0]),
            self.opacity,
            self.rgb,
            None if self.tint is None else self.tint * self.mean.new_tensor([1.0, 1.0, -1.0]),
            None if self.light is None else mirrored_light(self.light),
        )


def light_terms(x: Numbers, y: Numbers, z: Numbers) -> tuple[Numbers, ...]:
    """The nine spherical harmonics up to degree 2 of unit vectors, up to factors; all but the first have mean 0."""
    return (x**0, x, y, z, x * y, x * z, y * z, x * x - z * z, 3 * y * y - 1)


def mirrored_light(light: Float[Tensor, "batch 9 3"]) -> Float[Tensor, "batch 9 3"]:
    """The same for directions with z negated."""
    return light * light.new_tensor([1, 1, 1, -1, 1, -1, -1, 1, 1])[:, None]


@dataclass(frozen=True)
class Splats:
    """Gaussians as rays meet them: mean, precision and opacity after the pixel's footprint has widened them.

    `precision` holds arrays of shape (batch, splat).
    """

    mean: Float[Tensor, "batch splat 3"]
    precision: Symmetric3
    opacity: Float[Tensor, "batch splat"]


def splats_of(cloud: GaussianCloud) -> Splats:
    """Splats of a cloud seen by infinitely thin rays."""
    return Splats(cloud.mean, cloud.covariance().inverse(), cloud.opacity)


def widened_splats(
    cloud: GaussianCloud, eye: Float[Tensor, "batch 3"], footprint: Float[Tensor, "batch splat 3"]
) -> Splats:
    """Splats of a cloud seen by pixels whose footprint has the (diagonal) canonical variance `footprint`.

    `eye` is the camera centre, canonical. Sigma' = Sigma + footprint, and the opacity shrinks as the Gaussian's area
    across the line of sight grows, so that what a far pixel gathers stays the same: that area squared is v^T C v for a
    line of sight v and the cofactors C = det(Sigma) Sigma^-1.
    """
    covariance = cloud.covariance()
    wide = covariance.plus_diagonal(*planes3(footprint))
    cofactors, sight = wide.cofactors(), planes3(cloud.mean - eye[:, None])
    narrowing = covariance.cofactors().quadratic(sight) / cofactors.quadratic(sight)
    return Splats(cloud.mean, wide.inverse_by(cofactors), cloud.opacity * narrowing.clamp(max=1.0).sqrt())
