"""Codes for tests: of the lengths that a model has."""

from typing import Any

import torch

from carstudio.fitting.car_file import load_car
from carstudio.models.interface import CategoryModel, Latents
from carstudio.training.bundled import bundled_cars


def mean_latents(model: CategoryModel, cars: int = 1) -> Latents:
    """All zeros, as many as the model's codes have."""
    config: Any = model.config
    return Latents(torch.zeros(cars, config.code_size), torch.zeros(cars, _texture_size(config)))


def drawn_latents(generator: torch.Generator) -> Latents:
    """A car by chance for the bundled `car-gaussians`: one of the bundled cars with codes moved a little.

    Codes drawn from nowhere would be as long, but no car looks like what they make.
    """
    name = ("hatchback-grey", "sedan-white", "suv-red")[int(torch.randint(3, (1,), generator=generator))]
    own = load_car(bundled_cars()[name]).latents
    return Latents(*(code + 0.3 * torch.randn(code.shape, generator=generator) for code in (own.shape, own.texture)))


def _texture_size(config: Any) -> int:
    return int(getattr(config, "texture_size", config.code_size))
