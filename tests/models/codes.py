"""Codes for tests: of the length that a model has."""

from typing import Any

import torch

from carstudio.models.interface import CategoryModel, Latents


def mean_latents(model: CategoryModel, cars: int = 1) -> Latents:
    """All zeros, as many as the model's codes have."""
    size = model.config.code_size  # type: ignore[union-attr]
    return Latents(torch.zeros(cars, size), torch.zeros(cars, size))  # type: ignore[arg-type]


def drawn_latents(config: Any, generator: torch.Generator) -> Latents:
    """By chance, as large as the model's LayerNorm makes them."""
    shape, texture = torch.randn(2, 1, config.code_size, generator=generator)
    return Latents(shape, texture)
