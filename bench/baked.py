"""Baked previews: speed against the model and the paper-size Car-NeRF, likeness to the model's own pictures.

Usage: python -m bench.baked [--sizes 128 256] [--rounds 3] [--yardstick-size 64]

The three bundled cars from all around, ten metres away, on their box crop; "on the car": where the model's opacity is
above a half. Speed is of the white car, rays that miss the box included; rounds are interleaved, medians of processor
seconds a ray, ratios within a round. Car-NeRF draws a smaller view, which costs it as much a ray.
"""

import platform
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
import tyro

import carstudio
from bench.subject import Subject, steady
from carstudio.allocator import keep_freed_memory
from carstudio.fitting.car_file import load_car
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.interface import CategoryModel, Latents, render_image, window_of
from carstudio.recipes import car_nerf
from carstudio.training.bundled import bundled_models

CARS = ("sedan-white", "suv-red", "hatchback-grey")
DISTANCE_M, ELEVATION_DEG = 10.0, 10.0
YARDSTICK = "car-nerf"


@dataclass(frozen=True)
class Bench:
    """What to measure."""

    sizes: tuple[int, ...] = (128, 256)
    """Sides of the views, px."""
    rounds: int = 3
    views: int = 8
    """Azimuths for the likeness."""
    yardstick_size: int = 64
    """Side of the view that Car-NeRF draws, px (four seconds of processor time and round); 0: none."""


def placed(size: torch.Tensor, azimuth_deg: float) -> Box3D:
    """The car's box before the camera, a batch of one."""
    box = orbit_box(size, azimuth_deg=azimuth_deg, elevation_deg=ELEVATION_DEG, distance_m=DISTANCE_M)
    return Box3D(box.center[None], box.size[None], box.rotation[None])


def likeness(
    model: CategoryModel, latents: Latents, size: torch.Tensor, size_px: int, views: int
) -> list[tuple[float, float]]:
    """PSNR of the preview to the model's picture of each view: on the box crop, on the car."""
    baked, camera, found = carstudio.bake(model, latents), orbit_camera(size_px), []
    for view in range(views):
        box = placed(size, 20 + 360 * view / views)
        full, fast = render_image(model, camera, latents, box), baked.render(camera, box)
        x, y, width, height = window_of(box, camera)
        crop = (slice(y, y + height), slice(x, x + width))
        error = (full["rgb"] - fast["rgb"])[crop].square().mean(dim=-1)
        is_car = full["opacity"][crop] > 0.5
        on_crop, on_car = (float(-10 * part.mean().log10()) for part in (error, error[is_car]))
        found.append((on_crop, on_car))
    return found


def seconds_of(ways: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Processor seconds of each way in a steady state, round by round."""
    found: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(rounds):
        for way, draw in ways.items():
            found[way].append(steady(draw, torch.device("cpu"))[1])
    return found


@torch.no_grad()
def main(bench: Bench) -> None:
    """Print a Markdown table."""
    keep_freed_memory()
    model = carstudio.load_model("car-gaussians").eval()
    folder = bundled_models()["car-gaussians"].parent
    cars = [(car.latents, torch.tensor(car.size)) for car in (load_car(folder / name) for name in CARS)]
    latents, size = cars[0]
    baked, box = carstudio.bake(model, latents), placed(size, 20.0)
    print(
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {platform.machine()}; medians of "
        f"{bench.rounds} interleaved rounds; rays per processor second, rays that miss the box included.\n\n"
        "| view, px | drawn by | rays/CPU-s | baked over it | PSNR of baked to it, mean | worst | on the car, mean "
        "| worst |\n|---:|---|---:|---:|---:|---:|---:|---:|"
    )
    for size_px in bench.sizes:
        camera = orbit_camera(size_px)
        ways: dict[str, Callable[[], object]] = {
            "baked": partial(baked.render, camera, box),
            "model": partial(render_image, model, camera, latents, box),
        }
        num_rays = {"baked": size_px**2, "model": size_px**2, YARDSTICK: bench.yardstick_size**2}
        if bench.yardstick_size:
            subject = Subject(car_nerf(), torch.device("cpu"), rays_per_patch=1, size_px=bench.yardstick_size)
            subject.encode_first()
            ways[YARDSTICK] = subject.render_view
        seconds = seconds_of(ways, bench.rounds)
        found = torch.tensor([pair for car in cars for pair in likeness(model, *car, size_px, bench.views)])
        for way, own in seconds.items():
            pairs = zip(own, seconds["baked"], strict=True)
            ratio = statistics.median(a / b for a, b in pairs) * size_px**2 / num_rays[way]
            scores = [f"{found[:, i].mean():.2f} | {found[:, i].min():.2f}" for i in (0, 1)] if way == "model" else []
            cells = [f"{num_rays[way] / statistics.median(own):,.0f}", f"{ratio:,.1f}", *(scores or [" | "] * 2)]
            print(f"| {size_px} | {way} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Bench))
