"""How much a wrong 3-D box of the encoded photo costs; the box that the scored photo is drawn in is right.

Usage: python -m bench.box_errors STORE MODEL [MODEL ...] [--limit 128]
"""

import dataclasses
import math
from pathlib import Path
from statistics import fmean

import torch
import tyro

from carstudio.dataset.pixels import PreparedPatch
from carstudio.dataset.store import PatchStore, open_store
from carstudio.evaluation.protocols import EvaluationConfig, ViewPair, score_views, view_pairs
from carstudio.geometry.box3d import Box3D, displaced_box
from carstudio.models.interface import CategoryModel
from carstudio.training.checkpoint import load_model

# name: (shift along the car's axes as a share of its size, turn in degrees, size as a factor)
ERRORS: dict[str, tuple[float, float, float]] = {
    "none": (0.0, 0.0, 1.0),
    "place 3 %": (0.03, 0.0, 1.0),
    "place 6 %": (0.06, 0.0, 1.0),
    "heading 5 deg": (0.0, 5.0, 1.0),
    "heading 10 deg": (0.0, 10.0, 1.0),
    "size 5 %": (0.0, 0.0, 1.05),
    "size 10 %": (0.0, 0.0, 1.10),
}


def wrong_box(box: Box3D, error: tuple[float, float, float], generator: torch.Generator) -> Box3D:
    """The box with its place off by that share of each of its sizes, turned and scaled; signs are drawn."""
    share, turn_deg, factor = error
    signs = torch.randint(0, 2, (5,), generator=generator) * 2.0 - 1
    turn = torch.tensor(math.radians(turn_deg)) * signs[3]
    return displaced_box(box, share * signs[:3], turn, torch.full((3,), factor if signs[4] > 0 else 1 / factor))


def scores_with(
    model: CategoryModel, store: PatchStore, pairs: list[ViewPair], error: tuple[float, float, float]
) -> str:
    """PSNR / SSIM / mask IoU over the pairs, with the encoded photo's box wrong."""
    generator = torch.Generator().manual_seed(0)

    def alter(shown: PreparedPatch) -> PreparedPatch:
        return dataclasses.replace(shown, box=wrong_box(shown.box, error, generator))

    scores = [view.scores for view in score_views(model, store, pairs, alter=alter)]
    psnr, ssim, iou = (fmean(getattr(one, name) for one in scores) for name in ("psnr", "ssim", "mask_iou"))
    return f"{psnr:.2f} / {ssim:.3f} / {iou:.3f}"


def main(store: tyro.conf.Positional[Path], models: tyro.conf.Positional[tuple[str, ...]], limit: int = 128) -> None:
    """Print a table: one row per error, PSNR / SSIM / mask IoU of each model on novel views."""
    opened = open_store(store)
    pairs = view_pairs(opened, EvaluationConfig(protocol="novel-view", split=None, part="all", limit=limit))
    loaded = {name: load_model(name) for name in models}
    print("| error | " + " | ".join(loaded) + " |")
    print("|---" * (len(loaded) + 1) + "|")
    for name, error in ERRORS.items():
        cells = [scores_with(model, opened, pairs, error) for model in loaded.values()]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
