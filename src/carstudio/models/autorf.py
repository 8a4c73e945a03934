"""AutoRF (Mueller et al. 2022) in the canonical box: Car-NeRF's trunk and heads over points, in one even pass.

What is its own: no cones, a narrower trunk, 64 samples; its occupancy loss is `LossConfig.mask_error="log"`. Sizes are
those of the community code that the Car-Studio paper compares with.
"""

from dataclasses import dataclass, field
from typing import Literal

from carstudio.models.car_nerf import CarNeRF, CarNeRFConfig
from carstudio.rendering.field import SamplingConfig


@dataclass(frozen=True)
class AutoRFConfig(CarNeRFConfig):
    """Car-NeRF's fields with AutoRF's sizes."""

    sampling: SamplingConfig = field(default_factory=lambda: SamplingConfig(coarse=64, fine=0))
    """Samples along a ray: one pass."""
    width: int = 128
    """Width of the trunk."""
    position_encoding: Literal["integrated", "points"] = "points"
    """AutoRF encodes points."""
    position_frequencies: int = 10
    """Octaves of the positional encoding."""


class AutoRF(CarNeRF):
    """Encoder, two codes, point field."""
