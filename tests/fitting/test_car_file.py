"""Cars in files: what goes in comes out, and what is wrong with a file is said."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from carstudio.errors import InputError
from carstudio.fitting.car_file import DESCRIPTION, TENSORS, Car, load_car, put_weights, save_car
from carstudio.models.interface import Latents
from carstudio.models.zoo import build_model
from training.toy import TINY


def car(**changes: object) -> Car:
    generator = torch.Generator().manual_seed(0)
    values: dict[str, object] = {
        "latents": Latents(torch.randn(1, 16, generator=generator), torch.randn(1, 20, generator=generator)),
        "size": (4.2, 1.5, 1.8),
        "model_name": "tiny",
        "model_sha256": "0" * 64,
        "instance_id": "c-1",
        "licence": "CC0-1.0",
        "weights": {"field.density.bias": torch.tensor([0.25])},
        "provenance": {"steps": 3},
    }
    return Car(**(values | changes))  # type: ignore[arg-type]  # by name


def test_a_car_survives_to_the_bit(tmp_path: Path) -> None:
    save_car(tmp_path, car())
    back, ours = load_car(tmp_path), car()
    assert torch.equal(back.latents.shape, ours.latents.shape)
    assert torch.equal(back.latents.texture, ours.latents.texture)
    assert back.weights.keys() == ours.weights.keys()
    for name in ("size", "model_name", "model_sha256", "instance_id", "licence", "provenance"):
        assert getattr(back, name) == getattr(ours, name)


def test_fitted_weights_go_into_their_model_and_no_other(tmp_path: Path) -> None:
    model = build_model(TINY.model)
    put_weights(model, car(), name="c")
    assert model.state_dict()["field.density.bias"].item() == 0.25
    for weights in ({"field.density.bias": torch.zeros(2)}, {"nothing": torch.zeros(1)}):
        with pytest.raises(InputError, match="c: has weights of another model"):
            put_weights(model, car(weights=weights), name="c")


def edit(change: Callable[[dict[str, object]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        value = json.loads((folder / DESCRIPTION).read_text())
        change(value)
        (folder / DESCRIPTION).write_text(json.dumps(value))

    return apply


BROKEN: dict[str, Callable[[Path], None]] = {
    "expected a car (car.json and car.safetensors), found none": lambda folder: (folder / DESCRIPTION).unlink(),
    "expected format carstudio-car, version 1": edit(lambda value: value.update(format_version=2)),
    "size_m must have length, height and width in metres": edit(lambda value: value.update(size_m={"length": 4})),
    "size_m must": edit(lambda value: value.update(size_m={"length": -4, "height": 1, "width": 1})),
    "model must have a name and a sha256": edit(lambda value: value.update(model="tiny")),
    "instance_id, licence and sha256 must be texts": edit(lambda value: value.pop("licence")),
    "sha256 differs": edit(lambda value: value.update(sha256="1" * 64)),
    "not a whole safetensors file": lambda folder: (folder / TENSORS).write_bytes(b"1234"),
    "no such file; expected the weights": lambda folder: (folder / TENSORS).unlink(),
}


@pytest.mark.parametrize("message", BROKEN)
def test_broken_cars_are_explained(tmp_path: Path, message: str) -> None:
    save_car(tmp_path, car())
    BROKEN[message](tmp_path)
    with pytest.raises(InputError) as caught:
        load_car(tmp_path)
    assert message in str(caught.value)


def test_codes_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    save_car(tmp_path, car(latents=Latents(torch.full((1, 3), torch.nan), torch.zeros(1, 3))))
    with pytest.raises(InputError, match="shape must be one row of finite numbers"):
        load_car(tmp_path)
