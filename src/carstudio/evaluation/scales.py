"""Scores at smaller image sizes: what a model shows of the same view when a pixel covers more of the car.

The truth is the mean of the full-size photo (on black) over the cells of a pixel, which is what a sensor with larger
pixels would have seen; the model is asked for the small image directly. A model that knows how large its pixels are
(mip-NeRF's cones, Car-Studio's IPE) should lose nothing; one that samples points should show aliasing.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.evaluation.metrics import masked_mean, psnr, ssim_map
from carstudio.evaluation.protocols import EvaluationConfig, ViewPair
from carstudio.evaluation.results import ResultRow
from carstudio.geometry.camera import Camera
from carstudio.models.interface import CategoryModel, render_image
from carstudio.progress import Report, silent
from carstudio.training.batches import patch_batch, stack_boxes

DIVISORS = (1, 2, 4, 8)  # of the full size: the paper's 1, 1/2, 1/4, 1/8
LEAST_SIDE_PX = 4


@dataclass(frozen=True)
class SmallTruth:
    """A photo on black averaged over cells; cells with an unknown pixel are not known, `is_car` is wholly car."""

    rgb: Float[Tensor, "height width 3"]
    is_known: Bool[Tensor, "height width"]
    is_car: Bool[Tensor, "height width"]
    camera: Camera


def small_truth(patch: PreparedPatch, divisor: int) -> SmallTruth:
    """The photo at 1 / divisor of its size; what is left over at the right and the bottom is cut off."""
    height, width = patch.mask.shape[0] // divisor, patch.mask.shape[1] // divisor
    mask = patch.mask[: height * divisor, : width * divisor]
    is_car = mask == MaskValue.CAR
    on_black = patch.rgb[: height * divisor, : width * divisor].float() / 255 * is_car[..., None]
    cells = on_black.unflatten(0, (height, divisor)).unflatten(2, (width, divisor))
    known = (mask != MaskValue.UNKNOWN).unflatten(0, (height, divisor)).unflatten(2, (width, divisor))
    whole = is_car.unflatten(0, (height, divisor)).unflatten(2, (width, divisor))
    camera = patch.camera.crop(0, 0, width * divisor, height * divisor).resize(width, height)
    return SmallTruth(cells.mean(dim=(1, 3)), known.all(dim=3).all(dim=1), whole.all(dim=3).all(dim=1), camera)


@torch.no_grad()
def score_scales(
    model: CategoryModel,
    store: PatchStore,
    pairs: list[ViewPair],
    config: EvaluationConfig,
    template: ResultRow,
    *,
    report: Report = silent,
) -> list[ResultRow]:
    """Rows of every pair at every divisor (images below `LEAST_SIDE_PX` are left out); `split` of a row names the size.

    `template` gives the rows their method, steps and checksums.
    """
    device = next(model.parameters()).device
    cache = PatchCache(store, model.encoder_side_px)
    model.eval()
    rows = []
    for done, pair in enumerate(pairs, start=1):
        shown, scored = cache[pair.input_patch_id], cache[pair.scored_patch_id]
        latents = model.encode(patch_batch([shown]).to(device))
        box = stack_boxes([scored.box]).to(device)
        for divisor in DIVISORS:
            truth = small_truth(scored, divisor)
            if min(truth.is_known.shape) < LEAST_SIDE_PX or not bool(truth.is_known.any()):
                continue
            found = render_image(model, truth.camera.to(device), latents, box)["rgb"].cpu().clamp(0, 1)
            similarity = ssim_map(torch.where(truth.is_known[..., None], found, truth.rgb), truth.rgb)
            has_car = bool(truth.is_car.any())
            rows.append(
                replace(
                    template,
                    protocol=config.protocol,
                    split=f"{config.split}:{config.part} at {size_name(divisor)}",
                    instance_id=pair.instance_id,
                    patch_id=pair.scored_patch_id,
                    input_patch_id=pair.input_patch_id,
                    psnr=float(psnr(found, truth.rgb, truth.is_known)),
                    psnr_mask=float(psnr(found, truth.rgb, truth.is_car)) if has_car else None,
                    ssim=float(masked_mean(similarity, truth.is_known)),
                    ssim_mask=float(masked_mean(similarity, truth.is_car)) if has_car else None,
                    lpips=None,
                    mask_iou=None,
                )
            )
        report("smaller images", done, len(pairs), "")
    return rows


def size_name(divisor: int) -> str:
    """What a size is called: full size, 1/2, 1/4, 1/8."""
    return "full size" if divisor == 1 else f"1/{divisor}"
