"""How cost grows with the number of Gaussians. Usage: python -m bench.many [--splats 256 512 ...] [--rounds 5]

Fresh models of the recipe `car-gaussians` with so many Gaussians; rounds are interleaved, medians of processor seconds.
The exponent is the slope of log cost over log number: 1 is in proportion.
"""

import math
import platform
import statistics
from dataclasses import dataclass, replace

import torch
import tyro

from bench.subject import Subject, measure
from carstudio.allocator import keep_freed_memory
from carstudio.geometry.orbit import orbit_camera
from carstudio.models.baked import bake
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.recipes import car_gaussians
from carstudio.training.config import TrainConfig


@dataclass(frozen=True)
class Bench:
    """What to time."""

    splats: tuple[int, ...] = (256, 512, 1024, 2048, 4096)
    rounds: int = 5
    size: int = 128
    """Side of the rendered view, px."""


def recipe_of(num_splats: int) -> TrainConfig:
    """`car-gaussians` with another number of Gaussians."""
    config = car_gaussians()
    assert isinstance(config.model, CarGaussiansConfig)
    return replace(config, model=replace(config.model, num_splats=num_splats))


def exponent(counts: tuple[int, ...], seconds: list[float]) -> float:
    """Slope of the least-squares line through (log count, log seconds)."""
    x, y = [math.log(count) for count in counts], [math.log(value) for value in seconds]
    return statistics.linear_regression(x, y).slope


def main(bench: Bench) -> None:
    """Print a Markdown table."""
    keep_freed_memory()
    subjects = [Subject(recipe_of(count), torch.device("cpu"), size_px=bench.size) for count in bench.splats]
    actions = []
    for subject in subjects:
        subject.train_step()
        subject.encode_first()
        baked, box, camera = bake(subject.model, subject.latents), subject.first_box(), orbit_camera(bench.size)
        actions.append((subject.train_step, subject.render_view, lambda b=baked, x=box, c=camera: b.render(c, x)))
    rounds = [
        [[measure(action, subject.device)[1] for action in own] for subject, own in zip(subjects, actions, strict=True)]
        for _ in range(bench.rounds)
    ]
    seconds = [[statistics.median(r[i][k] for r in rounds) for i in range(len(subjects))] for k in range(3)]
    rays = subjects[0].rays, bench.size**2, bench.size**2
    print(
        f"torch {torch.__version__}, {torch.get_num_threads()} threads, {platform.machine()}; rays per processor "
        f"second, medians of {bench.rounds} interleaved rounds; views of {bench.size} x {bench.size} px.\n"
    )
    print("| Gaussians | training | rendering | baked preview |\n|---:|---:|---:|---:|")
    for i, count in enumerate(bench.splats):
        print(f"| {count} | " + " | ".join(f"{n / s[i]:,.0f}" for n, s in zip(rays, seconds, strict=True)) + " |")
    print("| cost grows as N to the | " + " | ".join(f"{exponent(bench.splats, s):.2f}" for s in seconds) + " |")
    last = [f"{math.log(s[-1] / s[-2]) / math.log(bench.splats[-1] / bench.splats[-2]):.2f}" for s in seconds]
    print("| the last step alone | " + " | ".join(last) + " |")


if __name__ == "__main__":
    main(tyro.cli(Bench))
