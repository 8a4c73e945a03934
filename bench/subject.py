"""What benchmarks of models measure: a recipe's training step and one view, in processor seconds."""

import statistics
import time
from collections.abc import Callable

import torch

from bench.patches import random_batch
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import orbit_camera
from carstudio.models.interface import render_image
from carstudio.models.zoo import build_model
from carstudio.rendering.rays import to_canonical
from carstudio.training.batches import generator_for
from carstudio.training.config import TrainConfig
from carstudio.training.losses import training_loss
from carstudio.training.optimizers import build_optimizer, clip
from carstudio.training.precision import Precision, autocast


class Subject:
    """A recipe with a fresh model, ready to train a step and to render a view."""

    def __init__(
        self,
        config: TrainConfig,
        device: torch.device,
        *,
        rays_per_patch: int | None = None,
        size_px: int = 128,
        precision: Precision | None = None,
    ) -> None:
        self.name, self.device, self.config = config.recipe, device, config
        torch.manual_seed(0)
        self.model = build_model(self.config.model).to(device)
        self.optimizer = build_optimizer(self.model, self.config.optimizer, rate=1e-4)
        own = self.config.rays_per_patch
        rays_per_patch = rays_per_patch or (own if own <= 512 else 128)
        patches, pixels = random_batch(
            self.config.patches_per_step,
            rays_per_patch,
            self.model.encoder_side_px,
            in_tiles=self.config.pixels == "in-cells",
        )
        self.patches, self.pixels = patches.to(device), pixels.to(device)
        self.precision = precision or self.config.precision
        self.rays_per_patch = rays_per_patch
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
        if self.config.clip_gradient is not None:
            clip(list(self.model.parameters()), self.config.clip_gradient)
        self.optimizer.step()

    def encode_first(self) -> None:
        """Latents of the first car, from which its views are rendered."""
        self.model.eval()
        with torch.no_grad():
            self.latents = self.model.encode(self.patches).select(0)

    def render_view(self) -> None:
        """One view of the first car, decoding its latents included, encoding its photo not."""
        if self.model.training:  # asked first: telling every module takes a twentieth of a view
            self.model.eval()
        render_image(self.model, orbit_camera(self.size_px).to(self.device), self.latents, self.first_box())

    def first_box(self) -> Box3D:
        """Where the first car stands, a batch of one."""
        return self.pixels.box.select(slice(0, 1))


def measure(action: Callable[[], object], device: torch.device) -> tuple[float, float]:
    """(wall seconds, processor seconds) of one call, the device's queue drained."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - wall, time.process_time() - processor


def steady(action: Callable[[], object], device: torch.device) -> tuple[float, float]:
    """`measure`; of an action that takes less than a second, medians of nine calls after that one.

    The first call after another subject finds its weights out of the caches.
    """
    first = measure(action, device)
    if first[0] > 1:
        return first
    wall, processor = zip(*(measure(action, device) for _ in range(9)), strict=True)
    return statistics.median(wall), statistics.median(processor)
