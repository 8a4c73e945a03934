"""Speed and memory of this machine: `./run bench` (or `python -m bench`) prints a Markdown table.

Training: one step (encode, trace, loss, backward, the recipe's optimiser) of a recipe with its own number of patches
and rays, or --rays rays of each patch (128 for paper-size recipes: the activations of 3 x 1,024 rays may not fit a
laptop). Rendering: one view of --size px of a car whose photo has been encoded before.
Rounds of the recipes are interleaved and medians are given, because shared machines drift; what takes less than a
second is done ten times a round. The ratio is to the first recipe within the same round. Memory: `bench.memory`, each
recipe in processes of its own.
"""

import argparse
import json
import platform
import statistics

import torch

from bench.memory import StepMemory, step_memory
from bench.subject import Subject, steady
from carstudio.allocator import keep_freed_memory
from carstudio.devices import pick_device
from carstudio.recipes import recipe
from carstudio.training.precision import resolve_precision


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
    subjects = [Subject(recipe(name), device, **sizes) for name in options.recipes]
    seconds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for subject in subjects:  # warm-up
        subject.train_step()
        subject.encode_first()
    for _ in range(options.rounds):
        for subject in subjects:
            seconds.setdefault((subject.name, "train"), []).append(steady(subject.train_step, device))
            seconds.setdefault((subject.name, "render"), []).append(steady(subject.render_view, device))
    memory = {subject.name: step_memory(subject.name, subject.rays_per_patch, options.device) for subject in subjects}
    rows = [row(subject, seconds, subjects[0], memory) for subject in subjects]
    print(json.dumps(rows, indent=2) if options.json else table(rows, device, options))


def row(
    subject: Subject,
    seconds: dict[tuple[str, str], list[tuple[float, float]]],
    base: Subject,
    memory: dict[str, StepMemory],
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
        "rays_per_patch": subject.rays_per_patch,
        "train_ratio": statistics.median((b[1] / base.rays) / (a[1] / subject.rays) for a, b in pairs),
        "render_rays_per_s": subject.size_px**2 / statistics.median(wall for wall, _ in render),
        "render_rays_per_cpu_s": subject.size_px**2 / statistics.median(cpu for _, cpu in render),
        "step_memory_mib": memory[subject.name].step_mib,
        "ray_memory_kib": memory[subject.name].ray_kib,
        "ray_memory_ratio": memory[base.name].ray_kib / memory[subject.name].ray_kib,
    }


def table(rows: list[dict[str, float | str]], device: torch.device, options: argparse.Namespace) -> str:
    """Markdown."""
    lines = [
        f"torch {torch.__version__}, {device}, {torch.get_num_threads()} threads, {platform.machine()}; "
        f"medians of {options.rounds} interleaved rounds; ratio per "
        f"processor second; render: one {options.size} x {options.size} view, rays that miss the box included; "
        "MiB: what a first step adds; KiB: what each further ray of a step adds, and the first recipe's over it.",
        "",
        "| recipe | patches x rays | precision | train rays/s | per CPU-s | ratio | render rays/s | per CPU-s | MiB "
        "| KiB/ray | ratio |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for found in rows:
        figures = [f"{found[key]:,.0f}" for key in ("train_rays_per_s", "train_rays_per_cpu_s")]
        figures += [f"{found['train_ratio']:.1f}"]
        figures += [f"{found[key]:,.0f}" for key in ("render_rays_per_s", "render_rays_per_cpu_s", "step_memory_mib")]
        figures += [f"{found['ray_memory_kib']:,.2f}", f"{found['ray_memory_ratio']:,.0f}"]
        lines.append(
            f"| {found['recipe']} | {found['patches']} x {found['rays_per_patch']} | {found['precision']} | "
            + " | ".join(figures)
            + " |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
