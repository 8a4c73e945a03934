"""Drives: a camera that goes straight past a car, and the same car turned where it stood."""

import numpy as np
import pytest
import torch

from carstudio.geometry.orbit import NUM_TURNS, turned_box, viewing_angles
from carstudio.synthetic.cameras import KITTI_CX, KITTI_FOCAL_PX, Viewpoint
from carstudio.synthetic.cars import Car
from carstudio.synthetic.drives import draw_drive, turned_views


@pytest.fixture(params=range(6))
def drive(request: pytest.FixtureRequest, red_car: Car) -> list[Viewpoint]:
    return draw_drive(np.random.default_rng(request.param), red_car.mesh, num_frames=9, size_px=64)


def places(drive: list[Viewpoint]) -> np.ndarray:
    return np.array([-view.rotation.T @ view.translation for view in drive])


def test_the_camera_goes_straight_past_the_car_at_one_height(drive: list[Viewpoint]) -> None:
    steps = np.diff(places(drive), axis=0)
    assert np.allclose(steps, steps[0], atol=1e-9)
    assert steps[0][1] == pytest.approx(0, abs=1e-12)
    distances = np.linalg.norm(places(drive)[:, [0, 2]], axis=1)
    assert (np.diff(distances) < 0).all()
    for view in drive:  # it looks where it goes: shaken by a degree
        assert view.rotation[2] @ steps[0] / np.linalg.norm(steps[0]) > np.cos(np.radians(5))


def test_the_car_is_in_kittis_picture_and_seen_from_a_narrow_range(drive: list[Viewpoint], red_car: Car) -> None:
    seen = []
    for view in drive:
        assert (red_car.mesh.vertices @ view.rotation[2] + view.translation[2]).min() > 0.5
        middle = KITTI_FOCAL_PX * view.translation[0] / view.translation[2] + KITTI_CX
        assert 0 < middle < 1242
        seen.append(float(viewing_angles(view.box(red_car.mesh))[0]))
    turns = np.diff(np.unwrap(seen))
    assert (np.sign(turns) == np.sign(turns[0])).all()
    assert 5 < np.degrees(np.abs(turns).sum()) < 45


def test_turned_views_are_the_car_of_a_strip(drive: list[Viewpoint], red_car: Car) -> None:
    """What `rotation_strip` draws: the box of the frame turned in place; azimuths go once around."""
    frame = drive[4]
    turned = turned_views(np.random.default_rng(0), red_car.mesh, frame, num_turns=NUM_TURNS, size_px=64)
    assert len(turned) == NUM_TURNS - 1
    for turn, view in enumerate(turned, start=1):
        expected = turned_box(frame.box(red_car.mesh), 2 * np.pi * turn / NUM_TURNS)
        torch.testing.assert_close(view.box(red_car.mesh).rotation, expected.rotation, rtol=0, atol=1e-6)
        torch.testing.assert_close(view.box(red_car.mesh).center, expected.center)
        assert np.isclose(np.exp(1j * view.azimuth_rad), np.exp(1j * float(viewing_angles(expected)[0])), atol=1e-5)
    around = np.sort([view.azimuth_rad for view in [frame, *turned]])
    assert np.allclose(np.diff(around), 2 * np.pi / NUM_TURNS)
    assert np.allclose(places([frame])[0][1], places(turned)[:, 1])
