"""Fitting cars to their prepared patches: `fitting.optimise` with pixels of patches and our loss."""

from collections.abc import Sequence

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
    the same in any company. `stops_early` looks at pixels of the same patches that no step shows. Runs on the model's
    device.
    """
    device = next(model.parameters()).device
    patches = [patch for car in cars for patch in car]
    places = [place for car in cars for place in range(len(car))]
    owner = torch.cat([torch.full((len(car),), i) for i, car in enumerate(cars)]).to(device)

    def draw(step: int, rays: int = rays) -> FitPixels:
        generators = [generator_for(seed, step, "pixels", place) for place in places]
        pixels = pixel_batch(patches, rays, generators).to(device)
        return FitPixels(pixels.rays, pixels.box, pixels.rgb, pixels.alpha, pixels.is_known, owner)

    held_out = draw(config.steps, _HELD_OUT_RAYS) if stops_early else None  # of a step that is never made
    start = encode_cars(model, cars)
    return fit(model, start, draw, objective, config, held_out=held_out, watch=watch, report=report)


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
