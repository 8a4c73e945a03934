"""Where fitting should stop: views that neither a step nor the stopping saw, after each way to stop.

Usage: python -m bench.stopping STORE [--split view] [--cars 12] [--steps 100] [--field-rate 3e-3] [--look-every 5]

The bundled `car-gaussians` is fitted to the training part of a split, one car at a time; the test part is scored. Each
line is a way to stop, with its paired difference to the first one and the 95 % interval of that by resampling cars;
then numbers of steps that are the same for all cars, and the best of these for each car in hindsight.
"""

import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro

import carstudio
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import open_store
from carstudio.evaluation.learning_curve import fittable_cars, score_fitted
from carstudio.evaluation.summary import estimate
from carstudio.fitting.optimise import FitConfig, Fitted
from carstudio.models.interface import CategoryModel, Latents
from carstudio.training.patch_fitting import fit_cars

FIXED = (0, 5, 10, 20, 40)


@dataclass(frozen=True)
class Bench:
    """What to measure."""

    store: tyro.conf.Positional[Path]
    split: str = "view"
    cars: int = 12
    steps: int = 100
    field_rate: float = 3e-3
    look_every: int = 5
    patience: int = 5
    held: tuple[int, ...] = (1, 2)
    refit: bool = False
    """Whether to fit all photographs anew for as long as the held-out ones said."""


def best_step(fitted: Fitted) -> int:
    """Steps after which the held-out loss was lowest."""
    return min(fitted.curve, key=lambda point: point[1])[0] if fitted.curve else fitted.steps


def score(
    model: CategoryModel,
    latents: Latents,
    weights: dict[str, torch.Tensor],
    photos: list[PreparedPatch],
    held_out: list[PreparedPatch],
) -> float:
    """Mean PSNR of views."""
    before = {name: value.clone() for name, value in model.state_dict().items() if name in weights}
    model.load_state_dict(weights, strict=False)
    found = [score_fitted(model, latents, photos[0], view).scores.psnr for view in held_out]
    model.load_state_dict(before, strict=False)
    return statistics.fmean(value for value in found if value is not None)


def main(options: Bench) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    store = open_store(options.store)
    cars = fittable_cars(store, options.split)
    cars = [cars[i * len(cars) // options.cars] for i in range(min(options.cars, len(cars)))]
    model = carstudio.load_model("car-gaussians")
    cache = PatchCache(store, model.encoder_side_px)
    base = FitConfig(
        steps=options.steps, field_rate=options.field_rate, look_every=options.look_every, patience=options.patience
    )
    ways = {"other pixels of the same photos": base}
    ways |= {f"{count} held-out view(s)": replace(base, hold_out_views=count) for count in options.held}
    found: dict[str, list[tuple[float, float, float]]] = {}
    fixed: dict[int, list[float]] = {}
    for car in cars:
        photos, held_out = ([cache[patch] for patch in part] for part in (car.fitted, car.held_out))

        def fitted(config: FitConfig, stops: bool, photos: list[PreparedPatch] = photos) -> tuple[Fitted, float]:
            began = time.process_time()
            done = fit_cars(model, [photos], config, stops_early=stops)
            return done, time.process_time() - began

        for name, config in ways.items():
            done, seconds = fitted(config, True)
            at = best_step(done)
            value = score(model, done.latents, done.weights, photos, held_out)
            found.setdefault(name, []).append((value, at, seconds))
            if config.hold_out_views and options.refit:
                again, more = fitted(replace(config, steps=at, hold_out_views=0), False)
                value = score(model, again.latents, again.weights, photos, held_out)
                found.setdefault(f"{name}, then all of them for as long", []).append((value, at, seconds + more))
        kept: dict[int, tuple[Latents, dict[str, torch.Tensor]]] = {}

        def watch(step: int, model: CategoryModel, latents: Latents, kept: dict = kept) -> None:
            if step in (*FIXED, options.steps):
                weights = dict(model.field_parameters()) if options.field_rate else {}
                copied = {name: weight.detach().clone() for name, weight in weights.items()}
                kept[step] = Latents(latents.shape.detach().clone(), latents.texture.detach().clone()), copied

        fit_cars(model, [photos], base, stops_early=False, watch=watch)
        for steps, (latents, weights) in kept.items():
            fixed.setdefault(steps, []).append(score(model, latents, weights, photos, held_out))
    print(f"{len(cars)} cars, {len(cars[0].fitted)} photos, {len(cars[0].held_out)} scored views of the first\n")
    print("| stopped by | PSNR of other views | against the first | steps kept, mean | CPU-seconds |")
    print("|---|---:|---:|---:|---:|")
    first = [value for value, *_ in next(iter(found.values()))]
    for name, rows in found.items():
        value, steps_kept, seconds = (statistics.fmean(part) for part in zip(*rows, strict=True))
        gain = _against(first, [row[0] for row in rows])
        print(f"| {name} | {value:.2f} | {gain} | {steps_kept:.0f} | {seconds:.2f} |")
    for steps, values in fixed.items():
        print(f"| {steps} steps | {statistics.fmean(values):.2f} | {_against(first, values)} | {steps} | |")
    hindsight = statistics.fmean(max(values) for values in zip(*fixed.values(), strict=True))
    print(f"| the best of these numbers, known afterwards | {hindsight:.2f} | | | |")


def _against(first: list[float], values: list[float]) -> str:
    apart = [value - other for value, other in zip(values, first, strict=True)]
    found = estimate(apart, [str(i) for i in range(len(apart))])
    return f"{found.mean:+.2f}" if found.low is None else f"{found.mean:+.2f} [{found.low:+.2f}, {found.high:+.2f}]"


if __name__ == "__main__":
    main(tyro.cli(Bench))
