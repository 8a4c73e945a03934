"""Cars of a scene: found by name, whole or refused, and those that come with the package."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from carstudio.errors import InputError
from carstudio.fitting.car_file import load_car
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance
from carstudio.models.interface import render_image
from carstudio.scene.shelf import CarShelf, copy_cars, find_car
from carstudio.training.batches import stack_boxes
from carstudio.training.bundled import bundled_cars
from scene.made_up_scene import made_up_car, made_up_scene, scene_with_cars


@pytest.mark.parametrize("name", ["hatchback-grey", "sedan-white", "suv-red"])
def test_bundled_cars_are_of_the_bundled_model_and_look_like_cars(name: str, tmp_path: Path) -> None:
    shelf = CarShelf(tmp_path)
    car = shelf.load(find_car(made_up_scene(), shelf, name))
    assert car.licence == "CC0-1.0"
    size = torch.tensor(car.size)
    box: Box3D = orbit_box(size, azimuth_deg=90.0, elevation_deg=8.0, distance_m=orbit_distance(size))
    image = render_image(shelf.model_of(car), orbit_camera(64), car.latents, stack_boxes([box]))
    length_px = int((image["opacity"] > 0.5).any(dim=0).sum())
    height_px = int((image["opacity"] > 0.5).any(dim=1).sum())
    assert 0.8 < (length_px / height_px) / (car.size[0] / car.size[1]) < 1.2  # seen from its side
    redness = image["rgb"][28:36, 20:44].mean(dim=(0, 1))
    assert (float(redness[0]) > 2 * float(redness[2])) == (name == "suv-red")


def test_every_bundled_car_has_its_card() -> None:
    for name, folder in bundled_cars().items():
        assert name in (folder / "README.md").read_text()


def test_cars_go_along_with_a_scene_and_names_never_clash(tmp_path: Path) -> None:
    scene, shelf = scene_with_cars(tmp_path / "a")
    target = CarShelf(tmp_path / "b")
    other = target.add(made_up_car(77), "track-1")  # another car has the name already
    copied = copy_cars(scene, shelf, target)
    assert copied.tracks["1"].car is not None
    assert copied.tracks["1"].car.name == "track-1-2"
    assert copied.tracks["2"].car == scene.tracks["2"].car
    assert copied.tracks["3"].car is None
    assert target.ref("track-1") == other
    assert copy_cars(scene, shelf, target) == copied  # a second time the same
    assert torch.equal(target.load(copied.tracks["1"].car).latents.shape, made_up_car(0).latents.shape)


def test_weights_that_fitting_changed_are_put_in(tmp_path: Path) -> None:
    shelf = CarShelf(tmp_path)
    plain = made_up_car(3)
    name = "colour.colours.bias"
    own = replace(plain, weights={name: torch.full_like(shelf.model_of(plain).state_dict()[name], 5.0)})
    shelf.add(own, "own")
    model = shelf.model_of(shelf.load(shelf.ref("own")))
    assert float(model.state_dict()[name].mean()) == 5.0
    assert float(shelf.model_of(plain).state_dict()[name].mean()) != 5.0  # the shared model stays as it is


def test_a_car_of_an_unknown_model_says_what_is_needed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not bundled; name its folder: --model RUN"):
        CarShelf(tmp_path).model_of(replace(made_up_car(1), model_sha256="f" * 64))


@pytest.mark.parametrize("name", ["../car", "/etc", "a/b", ""])
def test_names_stay_on_the_shelf(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        CarShelf(tmp_path).folder(name)
    with pytest.raises(InputError):
        find_car(made_up_scene(), CarShelf(tmp_path), name)


def test_a_damaged_car_is_not_taken(tmp_path: Path) -> None:
    shelf = CarShelf(tmp_path / "a")
    shelf.add(made_up_car(1), "one")
    (shelf.folder("one") / "car.safetensors").write_bytes(b"damaged")
    with pytest.raises(InputError):
        CarShelf(tmp_path / "b").take(shelf.folder("one"))
    assert not (tmp_path / "b/cars/one/car.json").exists()
    with pytest.raises(InputError, match="expected a car"):
        load_car(tmp_path / "b/cars/one")
