"""The learning curve: it starts at the encoder's result, is scored on views no step saw, and leaves the model alone."""

from pathlib import Path

import pytest
import torch

from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.learning_curve import (
    CurveConfig,
    FittableCar,
    fittable_cars,
    learning_curve,
    scored_views,
    turned_deg,
)
from carstudio.evaluation.metrics import score_image
from carstudio.models.interface import Latents, render_image
from carstudio.training.batches import patch_batch, stack_boxes
from carstudio.training.checkpoint import load_model
from carstudio.training.trainer import train
from training.toy import TINY, toy_store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store")


@pytest.fixture(scope="module")
def trained(store: PatchStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("toy") / "run"
    train(TINY, store, out, device="cpu")
    return out


def test_cars_have_views_on_both_sides(store: PatchStore) -> None:
    train_ids, test_ids = (set(store.patch_ids(kept=True, split="view", part=part)) for part in ("train", "test"))
    cars = fittable_cars(store)
    assert cars
    for car in cars:
        assert set(car.fitted) <= train_ids
        assert set(car.held_out) <= test_ids
        assert car.fitted
        assert car.held_out


def test_a_store_without_held_out_views_is_explained(tmp_path: Path) -> None:
    alone = toy_store(tmp_path / "store", cars=2, views=1)
    with pytest.raises(InputError, match="no car has kept views on both sides of split 'view'"):
        fittable_cars(alone)


@pytest.mark.parametrize("field_rate", [0.0, 3e-3])
def test_a_curve_starts_at_the_encoder_and_climbs(store: PatchStore, trained: Path, field_rate: float) -> None:
    model = load_model(trained)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    cars = fittable_cars(store)[:2]
    config = CurveConfig(marks=(0, 4, 25), latent_rate=0.05, field_rate=field_rate, rays=64, fitted_views=2)
    points = learning_curve(model, store, cars, config)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    seen = {(p.steps, p.views, p.scored.scored_patch.patch_id) for p in points}
    assert seen == {
        (steps, views, patch)
        for steps in (0, 4, 25)
        for car in cars
        for views, patches in (("held-out", car.held_out), ("fitted", car.fitted[:2]))
        for patch in patches
    }
    cache = PatchCache(store, model.encoder_side_px)
    scored = cache[cars[1].held_out[0]]
    with torch.no_grad():
        each = model.encode(patch_batch([cache[patch] for patch in cars[1].fitted]))
    start = Latents(each.shape.mean(0, keepdim=True), each.texture.mean(0, keepdim=True))
    image = render_image(model, scored.camera, start, stack_boxes([scored.box]))
    by_hand = score_image(image["rgb"], image["opacity"], scored.rgb.float() / 255, scored.mask)
    found = next(p for p in points if p.steps == 0 and p.scored.scored_patch.patch_id == scored.patch_id)
    assert found.scored.scores.psnr == pytest.approx(by_hand.psnr, abs=1e-3)

    def mean(steps: int) -> float:
        values = [p.scored.scores.psnr for p in points if p.steps == steps and p.views == "fitted"]
        return sum(value for value in values if value is not None) / len(values)

    assert mean(25) > mean(4) > mean(0)
    row = points[-1].row(config, method="tiny", steps=12, data_sha256="d", sha256="c")
    assert (row["fit_steps"], row["fit_field"]) == (25, field_rate > 0)
    assert {p.row(config, method="t", steps=1, data_sha256="", sha256="")["split"] for p in points} == {
        "view:test",
        "view:train",
    }


def test_company_changes_no_cars_curve(store: PatchStore, trained: Path) -> None:
    model = load_model(trained)
    cars = fittable_cars(store)[:2]
    config = CurveConfig(marks=(6,), latent_rate=0.05, rays=32, fitted_views=0)
    together = learning_curve(model, store, cars, config)
    alone = [point for car in cars for point in learning_curve(model, store, [car], config)]
    for a, b in zip(together, alone, strict=True):
        assert a.scored.pair == b.scored.pair
        torch.testing.assert_close(a.scored.rgb, b.scored.rgb, rtol=0, atol=1e-4)


def test_few_scored_views_go_from_the_nearest_to_the_farthest_around(store: PatchStore, trained: Path) -> None:
    cache = PatchCache(store, 8)
    names = [name for name in store.patch_ids() if cache[name].instance_id == cache[store.patch_ids()[0]].instance_id]
    car = FittableCar("c", (names[0],), tuple(names[1:]))
    angles = {name: turned_deg(cache[name], [cache[names[0]]]) for name in car.held_out}
    assert scored_views(car, cache, None) == scored_views(car, cache, len(names)) == car.held_out
    two = scored_views(car, cache, 2)
    assert [angles[name] for name in two] == [min(angles.values()), max(angles.values())]
    assert len(set(scored_views(car, cache, len(car.held_out) - 1))) == len(car.held_out) - 1
    config = CurveConfig(marks=(1,), rays=16, held_out_views=1, fitted_views=1)
    points = learning_curve(load_model(trained), store, [car], config)
    assert [p.scored.pair.scored_patch_id for p in points] == [*scored_views(car, cache, 1), names[0]]
