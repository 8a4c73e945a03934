"""A cloud of rotated 3-D Gaussians in the canonical frame, and what a pixel's cone makes of it.

Notation: mu mean, s scales, R rotation, Sigma = R diag(s^2) R^T covariance, P = Sigma^-1 precision, o opacity.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.transforms import rotation_from_quaternion


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

    def colour_from(self, eye: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch splat 3"]:
        """What a camera there (canonical) sees: rgb, tinted by the direction from which each Gaussian is seen."""
        if self.tint is None:
            return self.rgb
        sight = torch.nn.functional.normalize(self.mean.detach() - eye[:, None], dim=-1)
        return (self.rgb + (self.tint @ sight[..., None]).squeeze(-1)).clamp(0, 1)

    def covariance(self) -> Float[Tensor, "batch splat 3 3"]:
        """R diag(s^2) R^T."""
        axes = rotation_from_quaternion(self.quaternion) * torch.exp(self.log_scale)[..., None, :]
        return axes @ axes.mT

    def mirrored(self) -> "GaussianCloud":
        """The cloud on the car's other side (z negated): N R N with N = diag(1, 1, -1) turns (w, x, y, z)."""
        return GaussianCloud(
            self.mean * self.mean.new_tensor([1.0, 1.0, -1.0]),
            self.log_scale,
            self.quaternion * self.quaternion.new_tensor([1.0, -1.0, -1.0, 1.0]),
            self.opacity,
            self.rgb,
            None if self.tint is None else self.tint * self.mean.new_tensor([1.0, 1.0, -1.0]),
        )


@dataclass(frozen=True)
class Splats:
    """Gaussians as rays meet them: mean, precision and opacity after the pixel's footprint has widened them."""

    mean: Float[Tensor, "batch splat 3"]
    precision: Float[Tensor, "batch splat 3 3"]
    opacity: Float[Tensor, "batch splat"]


def splats_of(cloud: GaussianCloud) -> Splats:
    """Splats of a cloud seen by infinitely thin rays."""
    precision, _ = invert_symmetric(cloud.covariance())
    return Splats(cloud.mean, precision, cloud.opacity)


def widened_splats(
    cloud: GaussianCloud, eye: Float[Tensor, "batch 3"], footprint: Float[Tensor, "batch splat 3"]
) -> Splats:
    """Splats of a cloud seen by pixels whose footprint has the (diagonal) canonical variance `footprint`.

    `eye` is the camera centre, canonical. Sigma' = Sigma + footprint, and the opacity shrinks as the Gaussian's area
    across the line of sight grows, so that what a far pixel gathers stays the same: that area squared is
    det(Sigma) v^T Sigma^-1 v for a line of sight v.
    """
    covariance = cloud.covariance()
    precision, determinant = invert_symmetric(covariance)
    wide_precision, wide_determinant = invert_symmetric(covariance + torch.diag_embed(footprint))
    sight = cloud.mean - eye[:, None]
    area = determinant * quadratic(precision, sight)
    wide_area = wide_determinant * quadratic(wide_precision, sight)
    return Splats(cloud.mean, wide_precision, cloud.opacity * (area / wide_area).clamp(max=1.0).sqrt())


def quadratic(matrix: Float[Tensor, "*batch 3 3"], vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """v^T M v."""
    return ((matrix @ vector[..., None]).squeeze(-1) * vector).sum(dim=-1)


def invert_symmetric(
    matrix: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch"]]:
    """Inverse and determinant of symmetric, positive definite 3 x 3 matrices, by cofactors (elementwise, so fast)."""
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2]
    d, e, f = matrix[..., 1, 1], matrix[..., 1, 2], matrix[..., 2, 2]
    ca, cb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * ca + b * cb + c * cc
    cofactors = torch.stack([ca, cb, cc, cb, a * f - c * c, b * c - a * e, cc, b * c - a * e, a * d - b * b], dim=-1)
    return cofactors.unflatten(-1, (3, 3)) / determinant[..., None, None], determinant
