"""Recolouring: the truth is the same photograph in another paint, and scores mean what they say."""

from pathlib import Path

import numpy as np
import pytest
import torch

import carstudio.comparison.recolouring as recolouring
from carstudio.comparison.recolouring import (
    Recolouring,
    draw_recolourings,
    read_recolourings,
    score_recolouring,
    write_recolourings,
)
from carstudio.dataset.patch import MaskValue
from carstudio.models.interface import CategoryModel, Latents, PatchBatch
from carstudio.synthetic.cars import draw_car, paint_of


@pytest.fixture(scope="module")
def pair() -> Recolouring:
    return draw_recolourings(1, size_px=32, side_px=16)[0]


class Painter(CategoryModel):
    """Its texture code is the photo's mean car colour, or a constant: `render_image` is replaced by a flat picture."""

    encoder_side_px = 16

    def __init__(self, *, sees_colour: bool) -> None:
        super().__init__()
        self.anchor = torch.nn.Parameter(torch.zeros(1))
        self.sees_colour = sees_colour

    def encode(self, patches: PatchBatch) -> Latents:
        weight = patches.mask[:, None]
        colour = (patches.image * weight).sum(dim=(2, 3)) / weight.sum(dim=(2, 3))
        return Latents(colour[:, :1], colour if self.sees_colour else torch.full_like(colour, 0.4))


def test_only_the_paint_changes(pair: Recolouring) -> None:
    """Mask, camera and box are the same to the bit; background pixels too; the car's colour is not."""
    assert torch.equal(pair.before.mask, pair.after.mask)
    assert torch.equal(pair.before.camera.intrinsics, pair.after.camera.intrinsics)
    assert torch.equal(pair.before.box.center, pair.after.box.center)
    car = pair.after.mask == MaskValue.CAR
    far = torch.nn.functional.max_pool2d(car[None, None].float(), 17, stride=1, padding=8)[0, 0] == 0
    difference = (pair.before.rgb.float() - pair.after.rgb.float()).abs()
    assert float(difference[car].mean()) > 20
    if bool(far.any()):  # JPEG blocks and the sensor's blur spread a little
        assert float(difference[far].mean()) < 2
    assert pair.shape_photo.instance_id == pair.after.instance_id != pair.texture_photo.instance_id
    assert pair.shape_photo.patch_id != pair.after.patch_id, "another view is asked for than is shown"


@pytest.mark.parametrize(("share", "follow"), [(1.0, 1.0), (0.5, 0.5), (0.0, 0.0), (-1.0, -1.0)])
def test_follow_is_the_share_of_the_change_that_is_made(
    pair: Recolouring, monkeypatch: pytest.MonkeyPatch, share: float, follow: float
) -> None:
    """A renderer that goes a share of the way from the photo before to the photo after."""
    before, after = (photo.rgb.float() / 255 for photo in (pair.before, pair.after))
    model = Painter(sees_colour=True)
    own = model.encode(recolouring.patch_batch([pair.shape_photo])).texture
    car = (pair.after.mask == MaskValue.CAR).float()

    def draw(model: object, camera: object, latents: Latents, box: object) -> dict[str, torch.Tensor]:
        way = 0.0 if torch.equal(latents.texture, own) else share
        return {"rgb": before + way * (after - before), "opacity": car}

    monkeypatch.setattr(recolouring, "render_image", draw)
    score = score_recolouring(model, pair, method="m")
    assert score.follow == pytest.approx(follow, abs=1e-4)
    assert score.mask_iou == 1.0
    assert score.psnr is not None
    assert score.psnr_unchanged is not None
    if share == 1.0:
        assert score.psnr == 100.0
    if share == 0.0:
        assert score.psnr == pytest.approx(score.psnr_unchanged, abs=1e-4)
    if share == 0.5:  # half of the error is a quarter of its square: 6.02 dB
        assert score.psnr - score.psnr_unchanged == pytest.approx(6.02, abs=0.01)


def test_a_model_blind_to_colour_does_not_follow(pair: Recolouring, monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(model: object, camera: object, latents: Latents, box: object) -> dict[str, torch.Tensor]:
        shape = pair.after.mask.shape
        return {"rgb": latents.texture.expand(*shape, 3), "opacity": torch.ones(shape)}

    monkeypatch.setattr(recolouring, "render_image", draw)
    assert score_recolouring(Painter(sees_colour=False), pair, method="m").follow == 0.0
    assert score_recolouring(Painter(sees_colour=True), pair, method="m").follow > 0.3  # mean colours do follow paint


def test_scores_go_to_a_file_and_back(pair: Recolouring, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = pair.after.mask.shape
    blank = {"rgb": torch.zeros(*shape, 3), "opacity": torch.zeros(shape)}
    monkeypatch.setattr(recolouring, "render_image", lambda *arguments: blank)
    scores = [score_recolouring(Painter(sees_colour=True), pair, method="m")]
    write_recolourings(tmp_path / "scores.jsonl", scores)
    assert read_recolourings(tmp_path / "scores.jsonl") == scores


def test_a_cars_paint_is_told_without_building_it() -> None:
    for index in range(3):
        told, car = (make(np.random.default_rng([5, index])) for make in (paint_of, draw_car))
        assert told == car.paint
