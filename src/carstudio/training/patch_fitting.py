"""Fitting cars to their prepared patches: `fitting.optimise` with pixels of patches and our loss."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from carstudio.dataset.pixels import PreparedPatch
from carstudio.fitting.optimise import FitConfig, FitPixels, Fitted, Watch, fit, known_hits, select_rows
from carstudio.models.interface import CategoryModel, Latents
from carstudio.progress import Report, silent
from carstudio.rendering.volume import Rendering
from carstudio.training.batches import generator_for, patch_batch, pixel_batch
from carstudio.training.losses import LossConfig, training_loss

_HELD_OUT_RAYS = 512  # per photograph


def fit_patches(
    model: CategoryModel,
    patches: Sequence[PreparedPatch],
    config: FitConfig,
    *,
    rays: int = 256,
    seed: int = 0,
    report: Report = silent,
) -> Fitted:
    """Latents (a batch of one) that explain all patches of one car: `fit_cars` of one."""
    return fit_cars(model, [patches], config, rays=rays, seed=seed, report=report)


def fit_cars(
    model: CategoryModel,
    cars: Sequence[Sequence[PreparedPatch]],
    config: FitConfig,
    *,
    rays: int = 256,
    seed: int = 0,
    stops_early: bool = True,
    watch: Watch | None = None,
    report: Report = silent,
) -> Fitted:
    """Latents, one row per car, that explain all its patches; they start at the mean of the encoded ones.

    `rays` pixels per patch and step, drawn by (seed, step, place of the patch among its car's), so that a car is shown
    the same in any company. `stops_early` looks at patches that no step shows (`held_out_places`), or where a car has
    none of these at other pixels of its patches. Runs on the model's device.
    """
    device = next(model.parameters()).device
    held = [held_out_places(len(car), config.hold_out_views) if stops_early else () for car in cars]
    shown = [_Place(i, place) for i, car in enumerate(cars) for place in range(len(car)) if place not in held[i]]
    looked_at = [_Place(i, place) for i, car in enumerate(cars) for place in held[i] or range(len(car))]

    def draw(step: int, places: Sequence[_Place] = shown, rays: int = rays) -> FitPixels:
        generators = [generator_for(seed, step, "pixels", at.place) for at in places]
        pixels = pixel_batch([cars[at.car][at.place] for at in places], rays, generators).to(device)
        owner = torch.tensor([at.car for at in places], device=device)
        return FitPixels(pixels.rays, pixels.box, pixels.rgb, pixels.alpha, pixels.is_known, owner)

    # of a step that is never made
    held_out = draw(config.steps, looked_at, _HELD_OUT_RAYS) if stops_early else None
    start = encode_cars(model, cars)
    return fit(model, start, draw, objective, config, held_out=held_out, watch=watch, report=report)


class _Place(NamedTuple):
    """A patch: the car's number and the patch's among that car's."""

    car: int
    place: int


def held_out_places(num_patches: int, most: int) -> tuple[int, ...]:
    """Which of a car's patches tell when to stop instead of being shown: `most` of them, evenly spread, never all."""
    count = min(most, num_patches - 1)
    return tuple((2 * i + 1) * num_patches // (2 * count) for i in range(count))


@torch.no_grad()
def encode_cars(model: CategoryModel, cars: Sequence[Sequence[PreparedPatch]]) -> Latents:
    """Codes of cars, one row each: the mean over a car's patches; pixel features are those of its largest one."""
    device = next(model.parameters()).device
    if not model.is_coded:
        largest = [max(car, key=lambda patch: patch.mask.numel()) for car in cars]
        return model.encode(patch_batch(largest).to(device))
    each = [model.encode(patch_batch(list(car)).to(device)) for car in cars]
    return Latents(
        torch.stack([latents.shape.float().mean(dim=0) for latents in each]),
        torch.stack([latents.texture.float().mean(dim=0) for latents in each]),
    )


def objective(renderings: tuple[Rendering, ...], pixels: FitPixels) -> torch.Tensor:
    """The training loss of each car by itself, summed: no car's steps depend on its company.

    Colour counts against black, so that the silhouette does too.
    """
    counts = known_hits(pixels)
    losses = []
    for car in pixels.car.unique().tolist():
        rows = pixels.car == car
        own = tuple(select_rows(rendering, rows) for rendering in renderings)
        terms = training_loss(own, pixels.rgb[rows], pixels.alpha[rows], counts[rows], LossConfig(colour="whole-crop"))
        losses += list(terms.values())
    return torch.stack(losses).sum()
