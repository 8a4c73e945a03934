"""Time of fitting a car: cost of a step for each model, and how soon the fast model is near its plateau.

Usage: python -m bench.fit STORE [--cars 4] [--views 8] [--rounds 3] [--threads 4]

STORE has cars with several views (`carstudio synth`). Steps are those of `carstudio fit` on fresh models of recipes:
256 rays of each photo of a car, 16 for models at paper size; the table gives milliseconds for 1,000 rays. Rounds are
interleaved. The curve is of the bundled model: PSNR of views that no step saw (split `view`) against wall time, latents
and per-Gaussian numbers fitted together.
"""

import platform
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import carstudio
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import open_store
from carstudio.evaluation.learning_curve import CurveConfig, fittable_cars, learning_curve
from carstudio.fitting.optimise import FitConfig
from carstudio.models.interface import CategoryModel
from carstudio.models.zoo import build_model
from carstudio.recipes import recipe
from carstudio.training.patch_fitting import fit_cars

RECIPES = {"car-nerf": 16, "autorf": 16, "code-nerf": 16, "car-nerf-small": 256, "car-gaussians": 256}  # rays a photo
MARKS = (0, 5, 10, 20, 30, 50, 100, 200, 400)


@dataclass(frozen=True)
class Bench:
    """What to time."""

    store: tyro.conf.Positional[Path]
    cars: int = 4
    views: int = 8
    rounds: int = 3
    threads: int = 4


def step_seconds(model: CategoryModel, photos: list, *, field_rate: float, steps: int, rays: int = 256) -> float:
    """Wall seconds of a step, the first one apart."""
    starts: list[float] = []
    config = FitConfig(steps=steps + 1, field_rate=field_rate)
    fit_cars(model, [photos], config, rays=rays, stops_early=False, watch=lambda *_: starts.append(time.perf_counter()))
    return (starts[-1] - starts[1]) / steps


def main(options: Bench) -> None:
    """Print both tables."""
    torch.set_num_threads(options.threads)
    store = open_store(options.store)
    cars = fittable_cars(store)[: options.cars]
    torch.manual_seed(0)
    models = {name: build_model(recipe(name).model).eval() for name in RECIPES}
    print(f"{platform.machine()}, {options.threads} threads, {options.views} photos of one car\n")
    found: dict[tuple[str, bool], list[float]] = {}
    for _ in range(options.rounds):
        for name, model in models.items():
            cache = PatchCache(store, model.encoder_side_px)
            photos = [cache[patch] for patch in (cars[0].fitted + cars[0].held_out)[: options.views]]
            for with_field in (False, True):
                rays, rate = RECIPES[name], 1e-4 if with_field else 0.0
                seconds = step_seconds(model, photos, field_rate=rate, steps=2 if rays == 16 else 5, rays=rays)
                found.setdefault((name, with_field), []).append(seconds / (len(photos) * rays / 1000))
    print("| model | latents, ms per 1,000 rays | with field | against car-nerf |\n|---|---:|---:|---:|")
    for name in models:
        alone, both = (statistics.median(found[name, with_field]) for with_field in (False, True))
        ratio = statistics.median(a / b for a, b in zip(found["car-nerf", True], found[name, True], strict=True))
        print(f"| {name} | {alone * 1e3:.1f} | {both * 1e3:.1f} | {ratio:.0f} |")

    model = carstudio.load_model("car-gaussians")
    cache = PatchCache(store, model.encoder_side_px)
    config = CurveConfig(marks=MARKS, field_rate=3e-3, cars_per_batch=1)
    points = learning_curve(model, store, cars, config)
    photos = [cache[patch] for patch in cars[0].fitted]
    per_step = step_seconds(model, photos, field_rate=3e-3, steps=20)
    means = {}
    for mark in MARKS:
        values = [p.scored.scores.psnr for p in points if p.steps == mark and p.views == "held-out"]
        means[mark] = statistics.fmean(value for value in values if value is not None)
    best = max(means.values())
    print(f"\n{len(cars)} cars of {len(cars[0].fitted)} fitted photos: {per_step * 1e3:.1f} ms per step\n")
    print("| steps | seconds | held-out PSNR | to the best |\n|---:|---:|---:|---:|")
    for mark, value in means.items():
        print(f"| {mark} | {mark * per_step:.2f} | {value:.2f} | {value - best:+.2f} |")


if __name__ == "__main__":
    main(tyro.cli(Bench))
