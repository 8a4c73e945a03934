"""Cars: exact boxes, symmetry, outward faces, determinism."""

import numpy as np
import pytest
import trimesh

from carstudio.synthetic.cars import Car, build_car, draw_car
from carstudio.synthetic.materials import PAINTS, Finish, linear_from_srgb, srgb_from_linear
from carstudio.synthetic.styles import STYLE_NAMES, STYLES
from carstudio.synthetic.surfaces import NO_CHART


@pytest.fixture(scope="module")
def cars() -> dict[str, Car]:
    return {name: build_car(STYLES[name], PAINTS[7], np.random.default_rng(3)) for name in STYLE_NAMES}


@pytest.mark.parametrize("name", STYLE_NAMES)
def test_the_box_is_exact_and_centred_and_has_the_size_of_the_style(cars: dict[str, Car], name: str) -> None:
    mesh = cars[name].mesh
    used = mesh.vertices[np.unique(mesh.faces)]
    assert np.allclose(used.max(axis=0), mesh.size / 2, atol=1e-9)
    assert np.allclose(used.min(axis=0), -mesh.size / 2, atol=1e-9)
    length, height, width = STYLES[name].size
    assert abs(mesh.size[0] - length) < 0.01
    assert abs(mesh.size[1] - height) < 0.01
    assert width < mesh.size[2] < width + 0.13  # mirrors stick out by a few cm on either side


@pytest.mark.parametrize("name", STYLE_NAMES)
def test_left_and_right_mirror_each_other(cars: dict[str, Car], name: str) -> None:
    mesh = cars[name].mesh
    mirrored = {tuple(v) for v in np.round(mesh.vertices * [1, 1, -1], 6) + 0.0}
    assert mirrored == {tuple(v) for v in np.round(mesh.vertices, 6) + 0.0}


@pytest.mark.parametrize("name", STYLE_NAMES)
def test_front_and_rear_and_up_and_down_differ(cars: dict[str, Car], name: str) -> None:
    """The glasshouse is on top (y < 0): glass lies above the middle, tyres below."""
    mesh = cars[name].mesh
    centre = mesh.vertices[mesh.faces].mean(axis=1)
    tyres = centre[(mesh.face_material == Finish.TYRE) & (mesh.face_chart == NO_CHART)]
    assert tyres[:, 1].max() > 0.9 * mesh.size[1] / 2
    assert tyres[:, 1].mean() > 0.15
    front = mesh.vertices[mesh.vertices[:, 0] > 0.4 * mesh.size[0]]
    rear = mesh.vertices[mesh.vertices[:, 0] < -0.4 * mesh.size[0]]
    assert rear[:, 1].min() < front[:, 1].min() - 0.02  # every tail is higher than its nose (y points down)


@pytest.mark.parametrize("name", STYLE_NAMES)
def test_faces_wind_outwards_like_their_normals(cars: dict[str, Car], name: str) -> None:
    """Independent of our normals: trimesh's face normals by winding agree, and the signed volume is a car's."""
    mesh = cars[name].mesh
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    area = solid.area_faces
    smooth = mesh.normals[mesh.faces].mean(axis=1)
    agrees = (solid.face_normals * smooth).sum(-1) > 0
    assert area[agrees].sum() / area.sum() > 0.99
    box = np.prod(mesh.size)
    assert 0.3 * box < solid.volume < 0.95 * box  # shells overlap a little; inside-out parts would make it negative


def test_normals_have_unit_length(cars: dict[str, Car]) -> None:
    for car in cars.values():
        length = np.linalg.norm(car.mesh.normals, axis=1)
        assert np.isfinite(length).all()
        assert (np.abs(length - 1) < 1e-6).mean() > 0.98  # grids that close to a point have no normal there


def test_a_seed_decides_everything() -> None:
    a, b, other = (draw_car(np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(a.mesh.vertices, b.mesh.vertices)
    assert a.paint == b.paint
    assert a.mesh.vertices.shape != other.mesh.vertices.shape or not np.allclose(a.mesh.vertices, other.mesh.vertices)


def test_drawn_sizes_follow_the_statistics() -> None:
    rng = np.random.default_rng(0)
    sizes = np.array([STYLES["sedan"].vary(rng).size for _ in range(400)])
    assert np.allclose(sizes.mean(axis=0), STYLES["sedan"].size, atol=0.03)
    assert np.allclose(sizes.std(axis=0), STYLES["sedan"].size_std, rtol=0.25)


def test_srgb_round_trip_and_known_value() -> None:
    values = np.linspace(0, 1, 64)[:, None].repeat(3, 1)
    assert np.allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)
    assert np.allclose(linear_from_srgb(np.full((1, 3), 0.5)), 0.21404, atol=1e-5)  # IEC 61966-2-1
