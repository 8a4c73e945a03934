"""Pictures of a model at work: rows of input, truth, rendering, opacity and depth; turntables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.evaluation.protocols import EvaluationConfig, ScoredView, can_score, score_views, view_pairs
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance
from carstudio.images import to_uint8, write_png
from carstudio.models.baked import bake
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.report.colours import colour_depth, turbo
from carstudio.report.sheets import Pixels, side_by_side, view_pictures
from carstudio.training.batches import patch_batch


def truth_on_black(patch: PreparedPatch) -> Pixels:
    """What a rendering is compared with: the car's pixels, black elsewhere."""
    return np.where((patch.mask == MaskValue.CAR).numpy()[..., None], patch.rgb.numpy(), 0).astype(np.uint8)


def views_sheet(views: Sequence[ScoredView], *, tile_px: tuple[int, int] = (192, 128)) -> Pixels:
    """One row per scored view, with its scores below."""
    rows = [
        view_pictures(
            source=view.input_patch.rgb.numpy(),
            truth=truth_on_black(view.scored_patch),
            rgb=view.rgb.numpy(),
            opacity=view.opacity.numpy(),
            depth_m=view.depth_m.numpy(),
        )
        for view in views
    ]
    captions = [
        f"{view.scores.psnr or 0:.1f} dB  SSIM {view.scores.ssim or 0:.2f}  IoU {view.scores.mask_iou or 0:.2f}"
        for view in views
    ]
    return side_by_side(rows, captions=captions, tile_px=tile_px)


def views_panel(model: CategoryModel, store: PatchStore, path: Path, split: str | None, count: int) -> None:
    """Write a sheet of `count` views the model was not trained on (of the training data when there are none)."""
    part: Any = "test" if split and store.patch_ids(split=split, part="test") else "all"
    config = EvaluationConfig(protocol="novel-view", split=split, part=part, limit=count)
    if not can_score(store, config):
        config = replace(config, protocol="input-view")
    views = list(score_views(model, store, view_pairs(store, config)))
    write_png(path, views_sheet(views))


@dataclass(frozen=True)
class Turntable:
    """Frames of a car turning: colour on a background, opacity in Turbo, depth."""

    rgb: list[Pixels]
    opacity: list[Pixels]
    depth: list[Pixels]


def turntable(
    model: CategoryModel,
    latents: Latents,
    box: Box3D,
    *,
    views: int,
    size_px: int,
    elevation_deg: float = 12.0,
    background: float = 1.0,
    preview: bool = False,
) -> Turntable:
    """A car (batch of one) seen from `views` azimuths, the first at its front, going round by its left side.

    `preview` bakes it first (`models.baked`): faster, nearly the same, for models made of Gaussians alone.
    """
    device = latents.shape.device
    baked = bake(model, latents) if preview else None
    camera = orbit_camera(size_px)
    size = box.size[0].cpu()
    distance = orbit_distance(size)
    result = Turntable([], [], [])
    for i in range(views):
        placed = orbit_box(size, azimuth_deg=360 * i / views, elevation_deg=elevation_deg, distance_m=distance)
        batch = Box3D(placed.center[None], placed.size[None], placed.rotation[None]).to(device)
        drawn = baked.render(camera, batch) if baked else render_image(model, camera.to(device), latents, batch)
        image = {name: value.cpu() for name, value in drawn.items()}
        opacity = image["opacity"].numpy()
        rgb = image["rgb"].numpy() + (1 - opacity[..., None]) * background
        reach = float(size.norm()) / 2
        depth = np.where(opacity > 0.5, image["depth_m"].numpy(), np.nan)
        result.rgb.append(to_uint8(rgb))
        result.opacity.append(turbo(opacity))
        result.depth.append(colour_depth(depth, near_m=distance - reach, far_m=distance + reach))
    return result


@torch.no_grad()
def encode_patch(model: CategoryModel, store: PatchStore, patch_id: str) -> tuple[PreparedPatch, Latents, Box3D]:
    """A patch, its car's latents and its box as batches of one on the model's device."""
    device = next(model.parameters()).device
    prepared = PatchCache(store, model.encoder_side_px)[patch_id]
    batch = patch_batch([prepared]).to(device)
    return prepared, model.encode(batch), batch.box
