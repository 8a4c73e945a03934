"""Speed and memory of this machine: `./run bench` (or `python -m bench`) prints a Markdown table.

Training: one step (encode, trace, loss, backward, RAdam) of a recipe with its own number of patches and rays, or --rays
rays of each patch (128 for paper-size recipes: the activations of 3 x 1,024 rays may not fit a laptop). Rendering: one
view of --size px of a car whose photo has been encoded before.
Rounds of the recipes are interleaved and medians are given, because shared machines drift; the ratio is to the first
recipe within the same round. Memory is how far the first step raises the peak of the process.
"""

import argparse
import json
import platform
import resource
import statistics
import time
from collections.abc import Callable

import torch

from bench.patches import random_batch
from carstudio.allocator import keep_freed_memory
from carstudio.devices import pick_device
from carstudio.geometry.orbit import orbit_camera
from carstudio.models.interface import render_image
from carstudio.models.zoo import build_model
from carstudio.recipes import recipe
from carstudio.rendering.rays import to_canonical
from carstudio.training.batches import generator_for
from carstudio.training.losses import training_loss
from carstudio.training.precision import Precision, autocast, resolve_precision


class Subject:
    """A recipe with a fresh model, ready to train a step and to render a view."""

    def __init__(
        self, name: str, device: torch.device, *, rays_per_patch: int | None, size_px: int, precision: Precision | None
    ) -> None:
        self.name, self.device, self.config = name, device, recipe(name)
        torch.manual_seed(0)
        self.model = build_model(self.config.model).to(device)
        self.optimizer = torch.optim.RAdam(self.model.parameters(), lr=1e-4)
        own = self.config.rays_per_patch
        rays_per_patch = rays_per_patch or (own if own <= 512 else 128)
        batch = random_batch(self.config.patches_per_step, rays_per_patch, self.model.encoder_side_px)
        self.patches, self.pixels = (part.to(device) for part in batch)
        self.precision = precision or self.config.precision
        self.rays, self.size_px = self.config.patches_per_step * rays_per_patch, size_px

    def train_step(self) -> None:
        """What the trainer does in one step, without logging."""
        self.model.train()
        with autocast(self.precision, self.device):
            latents = self.model.encode(self.patches)
            rendered = self.model.render_levels(
                self.pixels.rays, latents, self.pixels.box, generator_for(0, 0, "jitter")
            )
        counts = self.pixels.is_known & to_canonical(self.pixels.rays, self.pixels.box).hit
        terms = training_loss(rendered, self.pixels.rgb, self.pixels.alpha, counts, self.config.loss)
        self.optimizer.zero_grad(set_to_none=True)
        torch.stack(list(terms.values())).sum().backward()
        self.optimizer.step()

    def encode_first(self) -> None:
        """Latents of the first car, from which its views are rendered."""
        self.model.eval()
        with torch.no_grad():
            self.latents = self.model.encode(self.patches).select(0)

    def render_view(self) -> None:
        """One view of the first car, decoding its latents included, encoding its photo not."""
        self.model.eval()
        box = type(self.pixels.box)(*(value[:1] for value in vars(self.pixels.box).values()))
        render_image(self.model, orbit_camera(self.size_px).to(self.device), self.latents, box)


def measure(action: Callable[[], None], device: torch.device) -> tuple[float, float]:
    """(wall seconds, processor seconds) of one call, the device's queue drained."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(prog="bench", description="Training and rendering speed of recipes")
    parser.add_argument(
        "--recipes", nargs="+", default=["car-nerf", "car-nerf-small", "car-gaussians", "car-gaussians-preview"]
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--rays", type=int, help="rays per patch of a training step; the recipe's own, at most 512")
    parser.add_argument("--size", type=int, default=128, help="side of the rendered view, px")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--precision", choices=["auto", "float32", "bfloat16"], help="of training; the recipe's own")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    keep_freed_memory()
    device = pick_device(options.device)
    sizes = {"rays_per_patch": options.rays, "size_px": options.size, "precision": options.precision}
    subjects = [Subject(name, device, **sizes) for name in options.recipes]
    seconds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    memory: dict[str, float] = {}
    for subject in subjects:  # warm-up, and the peak memory of one step
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        subject.train_step()
        subject.encode_first()
        memory[subject.name] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    for _ in range(options.rounds):
        for subject in subjects:
            seconds.setdefault((subject.name, "train"), []).append(measure(subject.train_step, device))
            seconds.setdefault((subject.name, "render"), []).append(measure(subject.render_view, device))
    rows = [row(subject, seconds, subjects[0], memory) for subject in subjects]
    print(json.dumps(rows, indent=2) if options.json else table(rows, device, options))


def row(
    subject: Subject, seconds: dict[tuple[str, str], list[tuple[float, float]]], base: Subject, memory: dict[str, float]
) -> dict[str, float | str]:
    """Medians and the median ratio to the first recipe, per ray."""
    train, render = seconds[subject.name, "train"], seconds[subject.name, "render"]
    pairs = zip(train, seconds[base.name, "train"], strict=True)
    return {
        "recipe": subject.name,
        "precision": resolve_precision(subject.precision, subject.device),
        "train_rays_per_s": subject.rays / statistics.median(wall for wall, _ in train),
        "train_rays_per_cpu_s": subject.rays / statistics.median(cpu for _, cpu in train),
        "patches": subject.config.patches_per_step,
        "rays_per_patch": subject.rays // subject.config.patches_per_step,
        "train_ratio": statistics.median((b[1] / base.rays) / (a[1] / subject.rays) for a, b in pairs),
        "render_rays_per_s": subject.size_px**2 / statistics.median(wall for wall, _ in render),
        "render_rays_per_cpu_s": subject.size_px**2 / statistics.median(cpu for _, cpu in render),
        "step_memory_mib": memory[subject.name],
    }


def table(rows: list[dict[str, float | str]], device: torch.device, options: argparse.Namespace) -> str:
    """Markdown."""
    lines = [
        f"torch {torch.__version__}, {device}, {torch.get_num_threads()} threads, {platform.machine()}; "
        f"medians of {options.rounds} interleaved rounds; ratio per "
        f"processor second; render: one {options.size} x {options.size} view, rays that miss the box included; "
        "MiB: memory of a step.",
        "",
        "| recipe | patches x rays | precision | train rays/s | per CPU-s | ratio | render rays/s | per CPU-s | MiB |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for found in rows:
        figures = [f"{found[key]:,.0f}" for key in ("train_rays_per_s", "train_rays_per_cpu_s")]
        figures += [f"{found['train_ratio']:.1f}"]
        figures += [f"{found[key]:,.0f}" for key in ("render_rays_per_s", "render_rays_per_cpu_s", "step_memory_mib")]
        lines.append(
            f"| {found['recipe']} | {found['patches']} x {found['rays_per_patch']} | {found['precision']} | "
            + " | ".join(figures)
            + " |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
