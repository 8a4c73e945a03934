"""Fitting one car's latents to its prepared patches: `fitting.optimise` with pixels of patches and our loss."""

from dataclasses import fields

import torch

from carstudio.dataset.pixels import PreparedPatch
from carstudio.fitting.optimise import FitConfig, FitPixels, Fitted, fit, known_hits
from carstudio.models.interface import CategoryModel, Latents
from carstudio.progress import Report, silent
from carstudio.rendering.volume import Rendering
from carstudio.training.batches import generator_for, patch_batch, pixel_batch
from carstudio.training.losses import LossConfig, training_loss

_HELD_OUT_RAYS = 512  # per photograph


def fit_patches(
    model: CategoryModel,
    patches: list[PreparedPatch],
    config: FitConfig,
    *,
    rays: int = 256,
    seed: int = 0,
    report: Report = silent,
) -> Fitted:
    """Latents (a batch of one) that explain all patches of one car; they start at the mean of the encoded ones.

    `rays` pixels per patch and step, drawn by (seed, step). Runs on the model's device.
    """
    device = next(model.parameters()).device
    with torch.no_grad():
        each = model.encode(patch_batch(patches).to(device))
    start = Latents(each.shape.float().mean(0, keepdim=True), each.texture.float().mean(0, keepdim=True))

    def draw(step: int, rays: int = rays) -> FitPixels:
        pixels = pixel_batch(patches, rays, generator_for(seed, step, "pixels")).to(device)
        car = torch.zeros(len(patches), dtype=torch.long, device=device)
        return FitPixels(pixels.rays, pixels.box, pixels.rgb, pixels.alpha, pixels.is_known, car)

    held_out = draw(config.steps, _HELD_OUT_RAYS)  # of a step that is never made
    return fit(model, start, draw, objective, config, held_out=held_out, report=report)


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


def select_rows(rendering: Rendering, rows: torch.Tensor) -> Rendering:
    """Some batch entries of a rendering."""
    return Rendering(**{part.name: getattr(rendering, part.name)[rows] for part in fields(Rendering)})
