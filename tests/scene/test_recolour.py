"""Recolouring: the shape stays to the bit, the paint follows, glass and tyres stay out of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.errors import InputError
from carstudio.files import write_json
from carstudio.fitting.car_file import Car, load_car
from carstudio.images import write_png
from carstudio.models.car_gaussians import CarGaussians
from carstudio.models.interface import CategoryModel, Latents
from carstudio.scene.graph import CarRef
from carstudio.scene.lifting import patch_description
from carstudio.scene.own_pictures import own_picture
from carstudio.scene.paint import PaintView, body_colour, paint_share, painted, parse_colour, to_linear
from carstudio.scene.recolour import PaintConfig, Way, mixed_texture, pictures_of, recolour_car
from carstudio.scene.recolour_measure import difference, recolour_truth, score_recolour
from carstudio.scene.shelf import PATCH, PATCH_DESCRIPTION, PATCH_MASK, CarShelf
from scene.made_up_scene import made_up_car

BLUE = (0.06, 0.2, 0.75)
QUICK = PaintConfig(views=4, side_px=48, steps=60, rays=400)


def plausible_car(seed: int) -> Car:
    """A car as the bundled encoder sees one: a rendering of made-up codes, encoded."""
    return replace(made_up_car(seed), latents=Latents(*(0.4 * code for code in _codes(seed))))


def _codes(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    latents = made_up_car(seed).latents
    return latents.shape, latents.texture


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> CarShelf:
    shelf = CarShelf(tmp_path_factory.mktemp("shelf"))
    for seed in (1, 2):
        shelf.add(plausible_car(seed), f"car-{seed}")
    return shelf


def recoloured(shelf: CarShelf, way: Way) -> Car:
    other = shelf.ref("car-2") if way == "mix" else None
    return shelf.load(recolour_car(shelf, shelf.ref("car-1"), way=way, colour=BLUE, other=other, config=QUICK))


@pytest.mark.parametrize("way", ["paint", "paper", "mix"])
def test_the_shape_stays_to_the_bit(shelf: CarShelf, way: Way) -> None:
    old, new = shelf.load(shelf.ref("car-1")), recoloured(shelf, way)
    model = shelf.model_of(old)
    assert isinstance(model, CarGaussians)
    assert torch.equal(old.latents.shape, new.latents.shape)
    assert not torch.equal(old.latents.texture, new.latents.texture)
    clouds = [model.decode(car.latents) for car in (old, new)]
    for part in ("mean", "log_scale", "quaternion", "opacity"):
        assert torch.equal(getattr(clouds[0], part), getattr(clouds[1], part))
    before, after = (pictures_of(model, car, QUICK) for car in (old, new))
    assert torch.equal(before.opacity, after.opacity)
    assert torch.equal(before.pixels.place, after.pixels.place)  # depth, as places on the car
    assert not torch.equal(before.pixels.rgb, after.pixels.rgb)


def test_paint_follows_the_colour_asked_for(shelf: CarShelf) -> None:
    old, new = shelf.load(shelf.ref("car-1")), recoloured(shelf, "paint")
    model = shelf.model_of(old)
    score = score_recolour(recolour_truth(model, old, BLUE, QUICK), pictures_of(model, new, QUICK))
    assert score.is_same_shape
    assert score.paint_error < score.paint_error_before / 2


def test_the_same_request_gives_the_same_car_and_does_no_work_twice(
    shelf: CarShelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = recolour_car(shelf, shelf.ref("car-1"), way="paint", colour="red", config=QUICK)
    elsewhere = CarShelf(tmp_path)
    elsewhere.take(shelf.folder("car-1"))
    again = recolour_car(elsewhere, elsewhere.ref("car-1"), way="paint", colour=(255.0, 0.0, 0.0), config=QUICK)
    assert first == again

    def never(self: CarShelf, car: Car) -> CategoryModel:
        raise AssertionError("loaded a model again")

    monkeypatch.setattr(CarShelf, "model_of", never)
    assert recolour_car(shelf, shelf.ref("car-1"), way="paint", colour="#ff0000", config=QUICK) == first


def test_none_of_another_texture_is_the_same_car_and_all_of_it_the_other(shelf: CarShelf) -> None:
    a, b = (shelf.load(shelf.ref(f"car-{number}")) for number in (1, 2))
    assert torch.equal(mixed_texture(a, b, 0.0), a.latents.texture)
    assert torch.equal(mixed_texture(a, b, 1.0), b.latents.texture)
    assert torch.allclose(mixed_texture(a, b, 0.5), (a.latents.texture + b.latents.texture) / 2)
    with pytest.raises(InputError, match="textures of two models do not mix"):
        mixed_texture(a, replace(b, model_sha256="0" * 64, model_name="other"), 0.5)


def test_the_papers_way_takes_the_photograph_that_lies_beside_the_car(shelf: CarShelf, tmp_path: Path) -> None:
    """A blue mask over a grey photograph and over a blue one give different codes; without one the car's own does."""
    textures = []
    for name, grey in (("dark", 20), ("bright", 220)):
        own = CarShelf(tmp_path / name)
        own.take(shelf.folder("car-1"))
        car = own.load(own.ref("car-1"))
        picture = own_picture(own.model_of(car), car, azimuth_deg=35.0)
        assert picture.box is not None
        write_png(own.folder("car-1") / PATCH, np.full_like(picture.image, grey))
        write_png(own.folder("car-1") / PATCH_MASK, picture.mask)
        description = patch_description(picture.camera.intrinsics, picture.box)
        write_json(own.folder("car-1") / PATCH_DESCRIPTION, description)
        new = recolour_car(own, own.ref("car-1"), way="paper", colour=BLUE)
        textures.append(own.load(new).latents.texture)
    assert not torch.allclose(*textures, atol=1e-3)
    write_json(own.folder("car-1") / PATCH_DESCRIPTION, {"intrinsics": [1]})
    with pytest.raises(InputError, match="not a patch's camera and box"):
        recolour_car(own, own.ref("car-1"), way="paper", colour="green")


@pytest.mark.parametrize(
    ("colour", "expected"),
    [
        ("#ff0080", (1, 0, 128 / 255)),
        ("Red", (1, 0, 0)),
        ((0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
        ((255.0, 51.0, 0.0), (1, 0.2, 0)),
    ],
)
def test_colours_are_read_in_their_usual_forms(colour: str | tuple[float, float, float], expected: object) -> None:
    assert parse_colour(colour) == pytest.approx(expected)


@pytest.mark.parametrize("colour", ["bleu", "#12", "", (-1.0, 0.0, 0.0), (300.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)])
def test_other_colours_are_refused(colour: str | tuple[float, float, float]) -> None:
    with pytest.raises(InputError, match="expected"):
        parse_colour(colour)


def red_car() -> PaintView:
    """A door in light and shade, a window, a tyre, a lamp, and road beyond the car."""
    rows = [  # colour, place (front, down, left), on the car
        ((0.8, 0.1, 0.1), (0.0, 0.3, 1.0), True),
        ((0.5, 0.06, 0.06), (-0.2, 0.3, -1.0), True),
        ((0.1, 0.1, 0.12), (0.0, -0.5, 1.0), True),
        ((0.1, 0.1, 0.1), (0.62, 0.6, 1.0), True),
        ((0.9, 0.9, 0.8), (0.95, 0.1, 0.7), True),
        ((0.4, 0.4, 0.4), (0.0, 0.3, 1.0), False),
        ((0.75, 0.1, 0.1), (0.0, -0.95, 0.0), True),
    ]
    colour, place, is_car = zip(*rows, strict=True)
    return PaintView(torch.tensor(colour), torch.tensor(place), torch.tensor(is_car))


def test_glass_tyres_lamps_and_the_road_are_no_paint() -> None:
    view = red_car()
    share = paint_share(view, body_colour(view))
    assert (share > 0.5).tolist() == [True, True, False, False, False, False, True]
    assert float(share[[2, 3, 4, 5]].max()) < 0.1


def test_dark_glass_of_a_black_car_is_left_alone() -> None:
    view = red_car()
    black = replace(view, rgb=torch.full_like(view.rgb, 0.12))
    share = paint_share(black, body_colour(black))
    assert float(share[0]) > 0.5
    assert float(share[2]) == 0.0


def test_shading_is_kept_where_the_colour_changes() -> None:
    view = red_car()
    paint = body_colour(view)
    new = painted(view.rgb, torch.ones(7), paint, BLUE)
    light, shade = to_linear(new[0]), to_linear(new[1])
    assert torch.allclose(shade / light, (shade / light).mean().expand(3), atol=1e-3)
    assert torch.equal(painted(view.rgb, torch.zeros(7), paint, BLUE), view.rgb)
    same = painted(view.rgb, torch.ones(7), paint, tuple((paint ** (1 / 2.2)).tolist()))
    assert torch.allclose(same[:2], view.rgb[:2], atol=0.05)


def test_a_car_without_a_body_in_sight_cannot_be_painted() -> None:
    view = red_car()
    with pytest.raises(InputError, match="cannot be painted"):
        body_colour(replace(view, is_car=torch.zeros(7, dtype=torch.bool)))


def test_the_difference_is_the_published_one() -> None:
    """Black and white are 100 apart in CIEDE2000; equal colours 0."""
    black, white = torch.zeros(1, 3), torch.ones(1, 3)
    assert difference(black, white) == pytest.approx(100, abs=0.01)
    assert difference(white, white) == 0
    assert difference(black[:0], white[:0]) == 0


def test_an_unknown_car_is_refused(shelf: CarShelf) -> None:
    with pytest.raises(InputError, match="expected a car"):
        recolour_car(shelf, CarRef("gone", "0" * 64), way="paint", colour=BLUE)
    assert load_car(shelf.folder("car-1")).instance_id == "made-up-1"


def test_a_car_with_colours_of_its_own_is_painted_in_them_too(shelf: CarShelf) -> None:
    """Weights fitted to the old paint would hold it: they move along, and nothing of the shape does."""
    old = shelf.load(shelf.ref("car-1"))
    model = shelf.model_of(old)
    own = {name: value.detach().clone() for name, value in model.field_parameters()}
    colours = own["colour.colours.bias"].view(-1, 3)
    own["colour.colours.bias"] = (colours + torch.tensor([1.5, -1.5, -1.5])).flatten()
    shelf.add(replace(old, weights=own), "fitted")
    config = QUICK
    ref = recolour_car(shelf, shelf.ref("fitted"), way="paint", colour="#1030c0", config=config)
    before, after = shelf.load(shelf.ref("fitted")), shelf.load(ref)
    assert {name for name in own if not torch.equal(after.weights[name], before.weights[name])} == {
        name for name in own if name.startswith("colour.")
    }
    truth = recolour_truth(shelf.model_of(before), before, parse_colour("#1030c0"), config)
    found = score_recolour(truth, pictures_of(shelf.model_of(after), after, config))
    code_alone = replace(after, weights=before.weights)
    without = score_recolour(truth, pictures_of(shelf.model_of(code_alone), code_alone, config))
    assert found.is_same_shape
    assert found.paint_error < 0.5 * found.paint_error_before
    assert found.paint_error < without.paint_error


def test_red_above_the_belt_line_is_paint_though_most_there_is_red() -> None:
    """A bonnet and pillars that outnumber the windows must not save the paint from being exchanged."""
    view = red_car()
    above = torch.tensor([[0.6, 0.08, 0.08]] * 4), torch.tensor([[0.7, -0.3, 0.2]] * 4), torch.tensor([True] * 4)
    parts = ((view.rgb, view.place, view.is_car), above)
    more = PaintView(*(torch.cat(pair) for pair in zip(*parts, strict=True)))
    share = paint_share(more, body_colour(more))
    assert float(share[-4:].min()) > 0.5
    assert torch.equal(share[:-4], paint_share(view, body_colour(view))), "windows stay windows"
