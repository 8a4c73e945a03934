"""Memory of a training step, measured in processes of their own. Usage: python -m bench.memory RECIPE RAYS_PER_PATCH

The peak of a process only ever rises, so that each figure needs a fresh one. What a step adds is the peak after it less
the memory before it (gradients and the optimiser's state included); what a ray adds is the difference between a step of
twice the rays and a step, so that the encoder, the weights and all else that does not grow with rays cancels.
"""

import argparse
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from bench.subject import Subject
from carstudio.allocator import keep_freed_memory
from carstudio.devices import pick_device
from carstudio.recipes import recipe


@dataclass(frozen=True)
class StepMemory:
    """MiB that a first step adds, and KiB for each ray more."""

    step_mib: float
    ray_kib: float


def step_memory(name: str, rays_per_patch: int, device: str) -> StepMemory:
    """Of a recipe; rays are doubled until they are a third of a step's memory, for less hides behind other peaks."""
    patches, rays = recipe(name).patches_per_step, rays_per_patch
    first = once = _in_a_process(name, rays, device)
    twice = _in_a_process(name, 2 * rays, device)
    while twice - once < twice / 3 and rays < 16 * rays_per_patch:
        rays, once, twice = 2 * rays, twice, _in_a_process(name, 4 * rays, device)
    return StepMemory(first / 2**20, max(twice - once, 1) / 2**10 / (patches * rays))


def _in_a_process(name: str, rays_per_patch: int, device: str) -> int:
    command = [sys.executable, "-m", "bench.memory", name, str(rays_per_patch), "--device", device]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def added_by_a_step(subject: Subject) -> int:
    """Bytes by which the peak rises above what was there before, on the device that trains."""
    if subject.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(subject.device)
        before = torch.cuda.memory_allocated(subject.device)
        subject.train_step()
        return torch.cuda.max_memory_allocated(subject.device) - before
    _forget_peak()
    before = _peak()
    subject.train_step()
    return _peak() - before


def _forget_peak() -> None:
    """Linux lowers the peak to what is in use now; elsewhere it stays that of the imports."""
    refs = Path("/proc/self/clear_refs")
    if refs.exists():
        refs.write_text("5")


def _peak() -> int:
    """Bytes of this process at their most."""
    status = Path("/proc/self/status")
    if status.exists():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main() -> None:
    """Print the bytes that one step adds."""
    parser = argparse.ArgumentParser(prog="bench.memory", description=__doc__)
    parser.add_argument("recipe")
    parser.add_argument("rays", type=int, help="per patch")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    keep_freed_memory()
    subject = Subject(recipe(options.recipe), pick_device(options.device), rays_per_patch=options.rays)
    print(added_by_a_step(subject))


if __name__ == "__main__":
    main()
