"""Smaller images: truth by averaging, models asked directly."""

import cv2
import numpy as np
import pytest
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.evaluation.protocols import EvaluationConfig, result_row, score_views, view_pairs
from carstudio.evaluation.scales import score_scales, small_truth
from carstudio.models.car_nerf import CarNeRF
from carstudio.models.interface import CategoryModel
from carstudio.rendering.rays import image_rays
from training.toy import TINY, toy_store

CONFIG = EvaluationConfig(protocol="input-view", split="view", part="test")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store", cars=2)


def patch(store: PatchStore) -> PreparedPatch:
    found = PatchCache(store, 16)[store.patch_ids()[1]]
    found.mask[3, 5] = MaskValue.UNKNOWN
    return found


def small_model() -> CategoryModel:
    torch.manual_seed(0)
    return CarNeRF(TINY.model).eval()  # type: ignore[arg-type]


@pytest.mark.parametrize("divisor", [1, 2, 4, 8, 3])
def test_the_truth_is_the_mean_over_cells(store: PatchStore, divisor: int) -> None:
    """Against OpenCV's area average, and against a loop over one cell; 40 px do not divide by 3."""
    whole = patch(store)
    truth = small_truth(whole, divisor)
    side = 40 // divisor
    black = np.where((whole.mask == MaskValue.CAR).numpy()[..., None], whole.rgb.numpy(), 0).astype(np.float32) / 255
    black = black[: side * divisor, : side * divisor]
    assert np.allclose(truth.rgb, cv2.resize(black, (side, side), interpolation=cv2.INTER_AREA), atol=1e-5)
    row, column = side // 2, side // 2
    cell = whole.mask[row * divisor : (row + 1) * divisor, column * divisor : (column + 1) * divisor]
    assert bool(truth.is_car[row, column]) == all(value == MaskValue.CAR for value in cell.flatten().tolist())
    assert not bool(truth.is_known[3 // divisor, 5 // divisor])
    assert int((~truth.is_known).sum()) == 1


def test_a_small_pixels_ray_is_the_mean_of_its_parts(store: PatchStore) -> None:
    """The camera of the small image looks through the middle of each cell: half-pixel shifts would show here."""
    whole = patch(store)
    small = small_truth(whole, 4)
    big = (through := image_rays(whole.camera).directions[0])[..., :2] / through[..., 2:]
    directions = image_rays(small.camera).directions[0]
    cells = big.view(10, 4, 10, 4, 2).mean(dim=(1, 3)).view(-1, 2)
    assert torch.allclose(directions[:, :2] / directions[:, 2:], cells, atol=1e-6)


def test_full_size_scores_are_those_of_the_usual_evaluation(store: PatchStore) -> None:
    model, pairs = small_model(), view_pairs(store, CONFIG)[:2]
    views = list(score_views(model, store, pairs))
    template = result_row(views[0], CONFIG, method="m", steps=3, data_sha256="d", checkpoint_sha256="c")
    rows = score_scales(model, store, pairs, CONFIG, template)
    assert len(rows) == 2 * 4
    full = [row for row in rows if row.split == "view:test at full size"]
    for row, view in zip(full, views, strict=True):
        assert row.patch_id == view.pair.scored_patch_id
        assert row.psnr == pytest.approx(view.scores.psnr, abs=1e-3)
        assert row.psnr_mask == pytest.approx(view.scores.psnr_mask, abs=1e-3)
        assert row.ssim_mask == pytest.approx(view.scores.ssim_mask, abs=1e-4)
    assert {row.method for row in rows} == {"m"}


def test_a_model_that_averages_scores_best_at_every_size(store: PatchStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """A renderer that hands out the averaged truth is perfect; one that picks each cell's corner pixel is not."""
    import carstudio.evaluation.scales as scales

    pairs = view_pairs(store, CONFIG)[:1]
    whole = PatchCache(store, 32)[pairs[0].scored_patch_id]
    view = next(score_views(small_model(), store, pairs))
    template = result_row(view, CONFIG, method="m", steps=3, data_sha256="d", checkpoint_sha256="c")

    def averaged(model: object, camera: object, *rest: object) -> dict[str, torch.Tensor]:
        return {"rgb": small_truth(whole, 40 // camera.width).rgb}  # type: ignore[attr-defined]

    def picked(model: object, camera: object, *rest: object) -> dict[str, torch.Tensor]:
        divisor = 40 // camera.width  # type: ignore[attr-defined]
        return {"rgb": small_truth(whole, 1).rgb[::divisor, ::divisor]}

    scores = {}
    for draw in (averaged, picked):
        monkeypatch.setattr(scales, "render_image", draw)
        scores[draw] = [row.psnr or 0 for row in score_scales(small_model(), store, pairs, CONFIG, template)]
    assert min(scores[averaged]) > 90
    assert scores[picked][0] > 90
    assert max(scores[picked][1:]) < 40
