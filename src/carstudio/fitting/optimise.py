"""Test-time optimisation (Car-Studio section IV-C): latents, and if asked the model, fitted to given photographs.

Latents start where the encoder puts them. Which pixels a step sees and what it wants of them arrive as functions.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.models.interface import CategoryModel, Latents
from carstudio.progress import Report, silent
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Rendering


@dataclass(frozen=True)
class FitConfig:
    """How a car is fitted."""

    steps: int = 100
    """Steps; 0 keeps the encoder's latents."""
    latent_rate: float = 1e-2
    """Learning rate of the latents (Adam)."""
    field_rate: float = 0.0
    """Learning rate of the model's own weights, the encoder aside; 0: they stay as they are, to the bit."""
    patience: int = 5
    """Stop after so many looks at the held-out pixels without a better one; the best is kept."""
    look_every: int = 10
    """Steps between looks at the held-out pixels."""

    def __post_init__(self) -> None:
        if self.steps < 0 or self.latent_rate < 0 or self.field_rate < 0 or min(self.patience, self.look_every) < 1:
            raise InputError("fit: steps and rates must be 0 or more, patience and looks at least 1")


@dataclass(frozen=True)
class FitPixels:
    """Rays of some photographs, what they show, and the car (row of the latents) each photograph is of."""

    rays: Rays
    box: Box3D
    rgb: Float[Tensor, "photo ray 3"]
    alpha: Float[Tensor, "photo ray"]
    counts: Bool[Tensor, "photo ray"]
    car: Int[Tensor, " photo"]


@dataclass(frozen=True)
class Fitted:
    """Latents of all cars, changed weights (empty where the model stayed), held-out losses (steps done, value)."""

    latents: Latents
    weights: dict[str, Tensor]
    curve: tuple[tuple[int, float], ...]
    steps: int


Objective = Callable[[tuple[Rendering, ...], FitPixels], Float[Tensor, ""]]


def fit(
    model: CategoryModel,
    start: Latents,
    draw: Callable[[int], FitPixels],
    objective: Objective,
    config: FitConfig,
    *,
    held_out: FitPixels | None = None,
    report: Report = silent,
) -> Fitted:
    """Fit the latents of a batch of cars; `draw(step)` gives the pixels of a step.

    `objective` gets the renderings of all sampling levels and the pixels; where it is a sum over cars, a car's latents
    take the same steps alone as in company. The model given is left as it is; where `field_rate` is above 0 a copy is
    fitted and its changed weights are returned.
    """
    if not model.is_coded:
        raise InputError("this model has no codes to fit: it looks a car up in its photo; fit one that has")
    shape, texture = start.shape.detach().clone(), start.texture.detach().clone()
    if config.steps == 0:
        return Fitted(Latents(shape, texture), {}, (), 0)
    fitted = copy.deepcopy(model) if config.field_rate else model
    weights = dict(field_parameters(fitted)) if config.field_rate else {}
    frozen = {name: p.requires_grad for name, p in fitted.named_parameters()}
    for name, parameter in fitted.named_parameters():
        parameter.requires_grad_(name in weights)
    try:
        return _descend(fitted, Latents(shape, texture), weights, draw, objective, config, held_out, report)
    finally:
        for name, parameter in fitted.named_parameters():
            parameter.requires_grad_(frozen[name])


def _descend(
    model: CategoryModel,
    latents: Latents,
    weights: dict[str, torch.nn.Parameter],
    draw: Callable[[int], FitPixels],
    objective: Objective,
    config: FitConfig,
    held_out: FitPixels | None,
    report: Report,
) -> Fitted:
    codes = [latents.shape.requires_grad_(), latents.texture.requires_grad_()]
    groups = [{"params": codes, "lr": config.latent_rate}]
    if weights:
        groups.append({"params": list(weights.values()), "lr": config.field_rate})
    optimizer = torch.optim.Adam(groups)
    best = _Best(codes, weights)
    done = 0
    for step in range(config.steps):
        if held_out is not None and step % config.look_every == 0:
            best.look(step, float(_loss(model, latents, held_out, objective).detach()), codes, weights)
            if best.misses >= config.patience:
                break
        loss = _loss(model, latents, draw(step), objective)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        done = step + 1
        report("fitting", done, config.steps, f"loss {float(loss.detach()):.4f}")
    if held_out is None:
        best.take(codes, weights)
    elif best.misses < config.patience:
        best.look(done, float(_loss(model, latents, held_out, objective).detach()), codes, weights)
    return Fitted(Latents(best.codes[0], best.codes[1]), best.weights, tuple(best.curve), done)


def field_parameters(model: CategoryModel) -> list[tuple[str, torch.nn.Parameter]]:
    """The parameters that act after encoding: all but those of the encoder and of the heads that make its codes."""
    encoding = ("encoder.", "shape_head.", "texture_head.", "shape_norm.", "texture_norm.", "colour_skip.")
    return [(name, p) for name, p in model.named_parameters() if not name.startswith(encoding)]


def _loss(model: CategoryModel, latents: Latents, pixels: FitPixels, objective: Objective) -> Float[Tensor, ""]:
    of_photos = Latents(latents.shape[pixels.car], latents.texture[pixels.car])
    return objective(model.render_levels(pixels.rays, of_photos, pixels.box), pixels)


def known_hits(pixels: FitPixels) -> Bool[Tensor, "photo ray"]:
    """Rays that count: their pixel is known and they hit the box."""
    return pixels.counts & to_canonical(pixels.rays, pixels.box).hit


class _Best:
    """The latents and weights that explained the held-out pixels best."""

    def __init__(self, codes: list[Tensor], weights: dict[str, torch.nn.Parameter]) -> None:
        self.value, self.misses = math.inf, 0
        self.curve: list[tuple[int, float]] = []
        self.take(codes, weights)

    def look(self, step: int, value: float, codes: list[Tensor], weights: dict[str, torch.nn.Parameter]) -> None:
        self.curve.append((step, value))
        if value < self.value:
            self.value, self.misses = value, 0
            self.take(codes, weights)
        else:
            self.misses += 1

    def take(self, codes: list[Tensor], weights: dict[str, torch.nn.Parameter]) -> None:
        self.codes = [code.detach().clone() for code in codes]
        self.weights = {name: weight.detach().clone() for name, weight in weights.items()}
