"""The baselines learn what they can: three ellipsoids of two colours each."""

from dataclasses import replace
from pathlib import Path

import pytest

from carstudio.comparison.budgets import BUDGETS, within
from carstudio.evaluation.protocols import EvaluationConfig, Protocol, score_views, view_pairs
from carstudio.recipes import recipe
from carstudio.training.checkpoint import load_model
from carstudio.training.schedule import ScheduleConfig
from carstudio.training.trainer import train
from training.toy import toy_store


def learned(name: str, protocol: Protocol, folder: Path) -> tuple[float, float]:
    """Mean PSNR and mask IoU after 300 steps at the size of `smoke`, trained by single-view supervision."""
    config = replace(
        within(BUDGETS["smoke"], recipe(name)),
        split=None,
        steps=300,
        patches_per_step=6,
        schedule=ScheduleConfig(first=5e-3, last=5e-4, decay_steps=None, warmup_steps=20),
    )
    store = toy_store(folder / "store")
    train(config, store, folder / "run", device="cpu")
    pairs = view_pairs(store, EvaluationConfig(protocol=protocol, split=None))
    scores = [view.scores for view in score_views(load_model(folder / "run"), store, pairs)]
    return sum(s.psnr or 0 for s in scores) / len(scores), sum(s.mask_iou or 0 for s in scores) / len(scores)


@pytest.mark.slow
def test_a_code_per_car_tells_both_its_colours(tmp_path: Path) -> None:
    """A car of one mean colour would score about 17 dB; the code joins all photos of a car: 24.6 dB were measured."""
    psnr, iou = learned("code-nerf", "novel-view", tmp_path)
    assert psnr > 21
    assert iou > 0.93


@pytest.mark.slow
def test_features_of_pixels_paint_the_photo_that_they_are_of(tmp_path: Path) -> None:
    """Global codes reach 19 dB here: only what is looked up at the right pixel can be sharp. Measured: 25.7 dB."""
    psnr, iou = learned("pixelnerf-resnet", "input-view", tmp_path)
    assert psnr > 22.5
    assert iou > 0.93
