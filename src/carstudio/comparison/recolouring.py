"""How well a car takes another car's colour: its shape code with the other's texture code, against the truth.

Truth can be had because the cars are synthetic: car A is photographed, then built again with B's paint and photographed
from the same places in the same street and light. The model sees one photo of A and one of B, takes A's shape and B's
texture, and is asked for another view of A. It is scored on A's car pixels by

- PSNR and SSIM against the repainted photo,
- PSNR of A as it was against the repainted photo: what leaving the colour alone would give,
- `follow`: how much of the change of mean colour it makes, <made, true> / <true, true>; 1 is all of it, 0 none.

The texture code also holds B's light and exposure, which no photo of A under its own tells: no model reaches all of it.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PreparedPatch, prepare_patch
from carstudio.dataset.sources.synthetic import SynthConfig, car_records
from carstudio.evaluation.metrics import score_image
from carstudio.files import parse_json, write_text
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.progress import Report, silent
from carstudio.synthetic.cars import paint_of
from carstudio.synthetic.materials import Paint
from carstudio.training.batches import patch_batch, stack_boxes

SEED = 20_260_722  # of cars that are used for nothing else
RIVALS = 4  # B is the car of the most different paint among so many that follow A


@dataclass(frozen=True)
class Recolouring:
    """Photos of one pair: A and B as the models see them, the view asked for as it was and repainted."""

    shape_photo: PreparedPatch
    texture_photo: PreparedPatch
    before: PreparedPatch
    after: PreparedPatch


@dataclass(frozen=True)
class RecolouringScore:
    """One pair's scores over car pixels."""

    method: str
    instance_id: str
    texture_from: str
    psnr: float | None
    ssim: float | None
    psnr_unchanged: float | None
    follow: float
    mask_iou: float | None


def draw_recolourings(count: int, *, size_px: int, side_px: int, report: Report = silent) -> list[Recolouring]:
    """Pairs of synthetic cars, each with its repainted truth; photos are encoded at `side_px`."""
    config = SynthConfig(out=Path(), cars=count + RIVALS, views=2, size=size_px, seed=SEED)
    pairs = []
    for index in range(count):
        other = max(range(index + 1, index + 1 + RIVALS), key=lambda rival: _difference(config, index, rival))
        paint = _paint(config, other)
        (shape_photo, before), (texture_photo, _) = (_photos(config, one, side_px) for one in (index, other))
        _, after = _photos(config, index, side_px, paint)
        pairs.append(Recolouring(shape_photo, texture_photo, before, after))
        report("repaint", index + 1, count, "")
    return pairs


def _paint(config: SynthConfig, index: int) -> Paint:
    return paint_of(np.random.default_rng([config.seed, index]))


def _difference(config: SynthConfig, index: int, other: int) -> float:
    colours = [np.array(_paint(config, one).srgb, float) for one in (index, other)]
    return float(np.linalg.norm(colours[0] - colours[1]))


def _photos(config: SynthConfig, index: int, side_px: int, repaint: Paint | None = None) -> list[PreparedPatch]:
    return [prepare_patch(record.decode(), side_px) for record in car_records(config, [], index, repaint=repaint)]


@torch.no_grad()
def score_recolouring(model: CategoryModel, pair: Recolouring, *, method: str) -> RecolouringScore:
    """Recolour one car and compare."""
    device = next(model.parameters()).device
    model.eval()
    own, other = (model.encode(patch_batch([photo]).to(device)) for photo in (pair.shape_photo, pair.texture_photo))
    box, camera = stack_boxes([pair.after.box]).to(device), pair.after.camera.to(device)
    pictures = [
        {name: value.cpu() for name, value in render_image(model, camera, latents, box).items()}
        for latents in (Latents(own.shape, other.texture), own)
    ]
    recoloured, unchanged = pictures
    truth, was = (photo.rgb.float() / 255 for photo in (pair.after, pair.before))
    scores = score_image(recoloured["rgb"], recoloured["opacity"], truth, pair.after.mask)
    plain = score_image(was, (pair.before.mask == MaskValue.CAR).float(), truth, pair.after.mask)
    car = pair.after.mask == MaskValue.CAR
    asked = truth[car].mean(dim=0) - was[car].mean(dim=0)
    made = recoloured["rgb"][car].mean(dim=0) - unchanged["rgb"][car].mean(dim=0)
    return RecolouringScore(
        method=method,
        instance_id=pair.shape_photo.instance_id,
        texture_from=pair.texture_photo.instance_id,
        psnr=scores.psnr_mask,
        ssim=scores.ssim_mask,
        psnr_unchanged=plain.psnr_mask,
        follow=float(made @ asked / (asked @ asked).clamp(min=1e-6)),
        mask_iou=scores.mask_iou,
    )


def write_recolourings(path: Path, scores: Sequence[RecolouringScore]) -> None:
    """One JSON object per pair."""
    write_text(path, "".join(json.dumps(asdict(score), allow_nan=False) + "\n" for score in scores))


def read_recolourings(path: Path) -> list[RecolouringScore]:
    """Inverse of `write_recolourings`."""
    names = [field.name for field in fields(RecolouringScore)]
    values = [parse_json(line, name=str(path)) for line in path.read_text(encoding="utf-8").splitlines()]
    return [RecolouringScore(**{name: value[name] for name in names}) for value in values]
