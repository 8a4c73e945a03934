"""Where a car's Gaussians start: spread over a rounded box, each a disc that lies in the surface."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.transforms import quaternion_from_rotation

ROUNDNESS = 6.0  # exponent of the superellipsoid |x|^p + |y|^p + |z|^p = 0.85^p the discs lie on
EXTENT = 0.85


@dataclass(frozen=True)
class Template:
    """Canonical means, log scales and quaternions of a car nobody has seen yet."""

    mean: Float[Tensor, "splat 3"]
    log_scale: Float[Tensor, "splat 3"]
    quaternion: Float[Tensor, "splat 4"]


def surface_template(count: int, *, is_half: bool) -> Template:
    """`count` discs evenly spread over the rounded box, or over its left half (z > 0)."""
    around = count * 2 if is_half else count
    directions = _fibonacci(around)[:count]  # z falls along the spiral: the first half has z > 0
    norm = (directions.abs() ** ROUNDNESS).sum(dim=-1, keepdim=True) ** (1 / ROUNDNESS)
    mean = EXTENT * directions / norm
    normal = torch.nn.functional.normalize(mean.abs() ** (ROUNDNESS - 1) * mean.sign(), dim=-1)
    spacing = math.sqrt(24 * EXTENT**2 / around)
    log_scale = torch.tensor([0.3 * spacing, 0.6 * spacing, 0.6 * spacing]).log().expand(count, 3).contiguous()
    return Template(mean, log_scale, quaternion_from_rotation(_frame(normal)))


def _fibonacci(count: int) -> Float[Tensor, "splat 3"]:
    """Unit vectors of a golden spiral around the z axis."""
    z = 1 - (2 * torch.arange(count, dtype=torch.float32) + 1) / count
    angle = torch.arange(count, dtype=torch.float32) * (math.pi * (3 - math.sqrt(5)))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)


def _frame(normal: Float[Tensor, "splat 3"]) -> Float[Tensor, "splat 3 3"]:
    """Rotations whose first axis is the normal."""
    aside = torch.where(
        normal[:, :1].abs() < 0.9, normal.new_tensor([1.0, 0.0, 0.0]), normal.new_tensor([0.0, 1.0, 0.0])
    )
    second = torch.nn.functional.normalize(torch.linalg.cross(normal, aside), dim=-1)
    return torch.stack([normal, second, torch.linalg.cross(normal, second)], dim=-1)
