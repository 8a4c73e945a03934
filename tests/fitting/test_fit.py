"""Fitting: what stays stays to the bit, what is fitted gets better, a batch is as good as one."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from carstudio.cli import run
from carstudio.commands.fit import car_folders, photographs_of
from carstudio.commands.opening import open_car
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.fitting.boxes import BoxFreedom
from carstudio.fitting.car_file import Car, load_car
from carstudio.fitting.optimise import FitConfig, Fitted
from carstudio.models.interface import CategoryModel
from carstudio.training.batches import patch_batch
from carstudio.training.checkpoint import load_model
from carstudio.training.patch_fitting import fit_cars, held_out_places
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


def cars(store: PatchStore) -> list[str]:
    return sorted(set(store.table(["instance_id"])["instance_id"].to_pylist()))


def fit_named(
    model: CategoryModel, store: PatchStore, names: list[str], config: FitConfig, looks: bool = False
) -> Fitted:
    cache = PatchCache(store, model.encoder_side_px)
    groups = [[cache[patch_id] for patch_id in photographs_of(store, name, None)] for name in names]
    return fit_cars(model, groups, config, rays=48, stops_early=looks)


def test_zero_steps_keep_the_encoders_latents(store: PatchStore, trained: Path) -> None:
    model = load_model(trained)
    name = cars(store)[0]
    found = fit_named(model, store, [name], FitConfig(steps=0))
    cache = PatchCache(store, model.encoder_side_px)
    with torch.no_grad():
        each = model.encode(patch_batch([cache[patch_id] for patch_id in photographs_of(store, name, None)]))
    assert torch.equal(found.latents.shape, each.shape.mean(0, keepdim=True))
    assert (found.weights, found.curve, found.steps) == ({}, (), 0)


def test_latents_get_better_and_the_model_stays_to_the_bit(store: PatchStore, trained: Path) -> None:
    model = load_model(trained)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    found = fit_named(model, store, [cars(store)[1]], FitConfig(steps=30, latent_rate=0.05), looks=True)
    assert found.weights == {}
    assert min(value for _, value in found.curve) < 0.985 * found.curve[0][1]
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.requires_grad for parameter in model.parameters())


def test_the_field_is_fitted_in_a_copy_and_does_more(store: PatchStore, trained: Path) -> None:
    model = load_model(trained)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    name = cars(store)[1]
    latents = fit_named(model, store, [name], FitConfig(steps=30), looks=True)
    both = fit_named(model, store, [name], FitConfig(steps=30, field_rate=5e-3), looks=True)
    assert min(v for _, v in both.curve) < min(v for _, v in latents.curve)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
    assert both.weights.keys() == {key for key, _ in model.field_parameters()}
    assert not any(key.startswith("encoder.") for key in both.weights)


def test_a_car_in_a_batch_is_fitted_as_alone(store: PatchStore, trained: Path) -> None:
    model, config = load_model(trained), FitConfig(steps=8)
    names = cars(store)[:3]
    together = fit_named(model, store, names, config)
    for index, name in enumerate(names):
        alone = fit_named(model, store, [name], config)
        torch.testing.assert_close(together.latents.shape[index], alone.latents.shape[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(together.latents.texture[index], alone.latents.texture[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("refines", [False, True], ids=["boxes stay", "boxes move"])
def test_company_changes_no_car_not_even_when_it_stops(store: PatchStore, trained: Path, refines: bool) -> None:
    """Cars pass their best at different steps; each keeps its own, as if it had been alone."""
    model = load_model(trained)
    cache = PatchCache(store, model.encoder_side_px)
    groups = [[cache[patch_id] for patch_id in photographs_of(store, name, None)] for name in cars(store)[:3]]
    freedom = BoxFreedom(refine_pose=refines, refine_size=refines, box_rate=0.1)
    config = FitConfig(steps=24, latent_rate=0.1, patience=1, look_every=3, box=freedom)
    together = fit_cars(model, groups, config, rays=32)
    ends, row, moved = set(), 0, 0.0
    for index, group in enumerate(groups):
        alone = fit_cars(model, [group], config, rays=32)
        ends.add(alone.steps)
        best = min(range(len(alone.curve)), key=lambda i: alone.curve[i][1])
        for place in range(best + 1):
            assert together.curves[index][place] == pytest.approx(alone.curve[place], rel=1e-3)
        torch.testing.assert_close(together.latents.shape[index], alone.latents.shape[0], rtol=1e-3, atol=1e-4)
        if refines:
            assert together.box is not None
            assert alone.box is not None
            moved += float((alone.box.center - torch.stack([p.box.center for p in group])).norm())
            torch.testing.assert_close(together.box.center[row], alone.box.center[0], rtol=1e-3, atol=1e-4)
        row += len(group)
    assert len(ends) > 1, "cars that all stop together would show nothing"
    assert (moved > 0.01) is refines


def test_held_out_places_are_few_and_spread() -> None:
    assert held_out_places(5, 0) == held_out_places(1, 3) == ()
    assert held_out_places(5, 1) == (2,)
    assert held_out_places(8, 2) == (2, 6)
    for count in range(2, 9):
        for most in range(1, 9):
            places = held_out_places(count, most)
            assert len(set(places)) == len(places) == min(most, count - 1)
            assert set(places) < set(range(count))


def test_no_step_sees_a_view_that_is_held_out(store: PatchStore, trained: Path) -> None:
    """What the view shows changes where the fit stops, and no step."""
    model = load_model(trained)
    cache = PatchCache(store, model.encoder_side_px)
    photos = [cache[patch_id] for patch_id in photographs_of(store, cars(store)[0], None)]
    (place,) = held_out_places(len(photos), 1)
    damaged = [replace(p, rgb=255 - p.rgb) if i == place else p for i, p in enumerate(photos)]
    config = FitConfig(steps=9, latent_rate=0.05, look_every=3, patience=9, hold_out_views=1)

    def watched(photos: list[PreparedPatch]) -> tuple[Fitted, list[torch.Tensor]]:
        seen: list[torch.Tensor] = []
        watch = lambda _, __, latents: seen.append(latents.shape.detach().clone())  # noqa: E731
        return fit_cars(model, [photos], config, rays=32, watch=watch), seen

    (truly, steps), (wrongly, same_steps) = watched(photos), watched(damaged)
    assert all(torch.equal(a, b) for a, b in zip(steps, same_steps, strict=True))
    assert truly.curves[0][0][1] != wrongly.curves[0][0][1]
    without = fit_cars(model, [photos], replace(config, hold_out_views=0), rays=32)
    assert not torch.equal(without.latents.shape, truly.latents.shape), "one photograph more is shown"


def test_company_changes_no_car_where_views_are_held_out(store: PatchStore, trained: Path) -> None:
    """Cars of one photograph among them, whose other pixels tell."""
    model = load_model(trained)
    cache = PatchCache(store, model.encoder_side_px)
    groups = [[cache[patch_id] for patch_id in photographs_of(store, name, None)] for name in cars(store)[:3]]
    groups[1] = groups[1][:1]
    config = FitConfig(steps=24, latent_rate=0.1, patience=1, look_every=3, hold_out_views=1)
    together = fit_cars(model, groups, config, rays=32)
    for index, group in enumerate(groups):
        alone = fit_cars(model, [group], config, rays=32)
        best = min(range(len(alone.curve)), key=lambda i: alone.curve[i][1])
        for place in range(best + 1):
            assert together.curves[index][place] == pytest.approx(alone.curve[place], rel=1e-3)
        torch.testing.assert_close(together.latents.shape[index], alone.latents.shape[0], rtol=1e-3, atol=1e-4)
    by_pixels = fit_cars(model, [groups[1]], replace(config, hold_out_views=0), rays=32)
    torch.testing.assert_close(together.latents.shape[1], by_pixels.latents.shape[0], rtol=1e-3, atol=1e-4)


def test_boxes_of_held_out_views_are_not_refined() -> None:
    with pytest.raises(InputError, match="take either hold-out-views, or refine-pose"):
        FitConfig(hold_out_views=1, box=BoxFreedom(refine_pose=True))
    with pytest.raises(InputError, match="hold-out-views must be 0 or more"):
        FitConfig(hold_out_views=-1)


def test_the_verb_fits_all_cars_and_keeps_those_that_are_there(
    store: PatchStore, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["fit", str(trained), "--data", str(store.path), "--out", str(tmp_path / "cars"), "--device", "cpu"]
    command += ["--steps", "3", "--cars-per-batch", "2", "--refine-pose", "--json"]
    assert run([*command, "--instance", "all"]) == 0
    said = json.loads(capsys.readouterr().out)["cars"]
    assert [told["instance_id"] for told in said] == cars(store)
    written = [Path(told["out"]) / "car.json" for told in said]
    first = load_car(written[0].parent)
    assert len(first.provenance["boxes"]) == len(first.provenance["patches"])
    (written[1].parent / "car.safetensors").write_bytes(b"damaged")
    stamps = [path.stat().st_mtime_ns for path in written]
    assert run([*command, "--instance", *cars(store)]) == 0
    now = [path.stat().st_mtime_ns for path in written]
    assert [a == b for a, b in zip(stamps, now, strict=True)] == [True, False, True]
    load_car(written[1].parent)
    assert car_folders(Path("o"), ["a/b", "a:b", "../x"]) == [Path("o/a_b-0"), Path("o/a_b-1"), Path("o/x")]


def test_the_verb_gives_each_car_a_field_of_its_own(store: PatchStore, trained: Path, tmp_path: Path) -> None:
    """A car is the same alone and with others, its weights too; only a batch that is asked for shares a field."""
    names = cars(store)[:2]

    def fitted(out: str, *more: str) -> dict[str, Car]:
        command = ["fit", str(trained), "--data", str(store.path), "--out", str(tmp_path / out), "--device", "cpu"]
        assert run([*command, "--steps", "3", "--field-rate", "1e-2", "--quiet", *more]) == 0
        folders = [path.parent for path in sorted((tmp_path / out).rglob("car.json"))]
        return {car.instance_id: car for car in map(load_car, folders)}

    alone = fitted("alone", "--instance", names[1])[names[1]]
    together = fitted("together", "--instance", *names)[names[1]]
    shared = fitted("shared", "--instance", *names, "--cars-per-batch", "2")[names[1]]
    assert alone.weights
    for name, weight in alone.weights.items():
        torch.testing.assert_close(together.weights[name], weight)
    assert any(not torch.allclose(shared.weights[name], weight) for name, weight in alone.weights.items())


def test_fitting_stops_when_held_out_pixels_get_no_better(store: PatchStore, trained: Path) -> None:
    model = load_model(trained)
    config = FitConfig(steps=500, latent_rate=2.0, patience=2, look_every=1)
    found = fit_named(model, store, [cars(store)[0]], config, looks=True)
    assert found.steps < 500
    values = [value for _, value in found.curve]
    assert min(values) <= values[0]
    assert values[-1] >= min(values)


def test_the_verb_writes_a_car_that_opens_with_its_model_alone(
    store: PatchStore, trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = cars(store)[0]
    command = ["fit", str(trained), "--data", str(store.path), "--instance", name, "--out", str(tmp_path / "car")]
    assert run([*command, "--steps", "5", "--field-rate", "1e-3", "--device", "cpu", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["instance_id"] == name
    assert len(said["patches"]) > 1
    car = load_car(tmp_path / "car")
    assert (car.model_name, car.licence) == ("tiny", "CC0-1.0")
    model, again = open_car(tmp_path / "car", trained)
    assert torch.equal(again.latents.shape, car.latents.shape)
    assert torch.equal(model.state_dict()["field.density.weight"], car.weights["field.density.weight"])
    turn = ["render", str(tmp_path / "car"), "--run-of-car", str(trained), "--out", str(tmp_path / "turn")]
    assert run([*turn, "--views", "2", "--size", "24", "--device", "cpu"]) == 0
    assert {path.name for path in (tmp_path / "turn").iterdir()} == {
        "rgb",
        "opacity",
        "depth",
        "turntable.gif",
        "turntable.mp4",
    }
    assert run(["export", str(tmp_path / "car"), "--format", "ply", "--out", str(tmp_path / "c.ply")]) == 2
    assert "made with the model tiny" in capsys.readouterr().err
    export = ["export", str(tmp_path / "car"), "--model", str(trained)]
    assert run([*export, "--format", "ply", "--out", str(tmp_path / "c.ply")]) == 2
    assert "tiny is not made of Gaussians; take --format glb" in capsys.readouterr().err
    other = tmp_path / "other"
    train(TINY.__class__(**{**vars(TINY), "seed": 1, "steps": 1}), store, other, device="cpu")
    with pytest.raises(InputError, match=r"not the model that .* was made with"):
        open_car(tmp_path / "car", other)
    with pytest.raises(InputError, match="no kept photograph with a 3-D box of 'nobody'"):
        photographs_of(store, "nobody", None)
