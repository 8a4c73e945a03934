"""A recipe beside the first prototype's, for so many processor seconds each: quality on the frozen set's cars.

Usage: python -m bench.prototype STORE FROZEN --out FOLDER [--recipes prototype car-gaussians] [--cpu-seconds 1200]

All of STORE is trained on; FROZEN is the benchmark set (`carstudio synth --frozen-benchmark`). Run recipes on cores of
their own or on a quiet machine: crowded cores make seconds shorter. The prototype: 256 Gaussians along the box's axes,
not widened, without mirrored pairs or tint, the crop's encoder, one rate of 5e-3 for all.
"""

from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch
import tyro

from carstudio.dataset.store import open_store
from carstudio.evaluation.protocols import EvaluationConfig, ScoredView, score_views, view_pairs
from carstudio.models import car_gaussians
from carstudio.models.car_gaussians import CarGaussiansConfig, GeometryDecoder
from carstudio.recipes import recipe
from carstudio.rendering.gaussians.tracing import SplattingConfig
from carstudio.training.checkpoint import load_model
from carstudio.training.config import TrainConfig
from carstudio.training.losses import LossConfig
from carstudio.training.schedule import ScheduleConfig
from carstudio.training.trainer import train

PROTOTYPE = "prototype"


class AxisAligned(GeometryDecoder):
    """Gaussians that are never turned."""

    def forward(self, shape: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """As its base, with the identity for a rotation."""
        mean, log_scale, quaternion, opacity = super().forward(shape)
        return mean, log_scale, torch.zeros_like(quaternion) + quaternion.new_tensor([1.0, 0, 0, 0]), opacity


def prototype() -> TrainConfig:
    """Its recipe; `AxisAligned` is the part of it that no config tells."""
    model = CarGaussiansConfig(
        num_splats=256, is_symmetric=False, tint_width=0, splatting=SplattingConfig(most=32, widen=False)
    )
    return replace(
        recipe("car-gaussians"),
        model=model,
        loss=LossConfig(colour="whole-crop"),
        schedule=ScheduleConfig(first=5e-3, last=1e-4, decay_steps=None, warmup_steps=100),
        optimizer="radam",
        second_moment=0.999,
        template_rate=1.0,
        mirroring="off",
        box_noise=0.0,
        patches_per_step=16,
        rays_per_patch=512,
        pixels="anywhere",
    )


def exposed_psnr(view: ScoredView) -> float:
    """PSNR in dB over the crop, the truth on black, after the gain that suits the picture best."""
    truth = view.scored_patch.rgb.float() / 255 * (view.scored_patch.mask == 255)[..., None]
    gain = (view.rgb * truth).sum() / (view.rgb**2).sum().clamp(min=1e-8)
    return float(-10 * torch.log10(((gain * view.rgb - truth) ** 2).mean()))


def main(
    store: tyro.conf.Positional[Path],
    frozen: tyro.conf.Positional[Path],
    out: Path,
    recipes: tuple[str, ...] = (PROTOTYPE, "car-gaussians"),
    cpu_seconds: float = 1200.0,
    box_noise: float | None = None,
    limit: int = 128,
) -> None:
    """Train and print a table row each: PSNR / SSIM / mask IoU (PSNR after the best gain) of both protocols."""
    torch.set_num_threads(1)
    benchmark = open_store(frozen)
    for name in recipes:
        config = prototype() if name == PROTOTYPE else recipe(name)
        if box_noise is not None and name != PROTOTYPE:
            config = replace(config, box_noise=box_noise)
        plain = car_gaussians.GeometryDecoder
        car_gaussians.GeometryDecoder = AxisAligned if name == PROTOTYPE else plain  # type: ignore[misc]
        try:
            config = replace(config, split=None, cpu_seconds=cpu_seconds, save_every=1000)
            done = train(config, open_store(store), out / name, device="cpu")
            model = load_model(out / name)
        finally:
            car_gaussians.GeometryDecoder = plain  # type: ignore[misc]
        cells = []
        for protocol in ("novel-view", "input-view"):
            asked = EvaluationConfig(protocol=protocol, split=None, part="all", limit=limit)  # type: ignore[arg-type]
            views = list(score_views(model, benchmark, view_pairs(benchmark, asked)))
            psnr, ssim, iou = (fmean(getattr(v.scores, key) for v in views) for key in ("psnr", "ssim", "mask_iou"))
            cells.append(f"{psnr:.2f} / {ssim:.3f} / {iou:.3f} ({fmean(map(exposed_psnr, views)):.2f})")
        print(f"| {name} | {done.steps} | {cells[0]} | {cells[1]} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
