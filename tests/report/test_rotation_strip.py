"""The strip turns the car, not the camera, to its left, and comes back where it began; the truth lies on it."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

import carstudio
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import open_store
from carstudio.geometry.box3d import box_from_kitti
from carstudio.geometry.camera import Camera
from carstudio.models.interface import render_image
from carstudio.report.rotation_strip import rotation_strip, seen_by, strip_camera, true_views, turns
from models.codes import mean_latents


def test_a_strip_is_the_car_at_other_yaws() -> None:
    model = carstudio.load_model("car-gaussians")
    latents = mean_latents(model)
    camera = Camera(torch.tensor([90.0, 90.0, 32.0, 24.0]), 64, 48)

    def box(yaw: float):
        bottom, size = torch.tensor([[0.2, 1.2, 8.0]]), torch.tensor([[4.2, 1.5, 1.8]])
        return box_from_kitti(bottom, size, torch.tensor([yaw]))

    strip = rotation_strip(model, latents, box(0.4), camera, steps=5, background=0.0)
    assert len(strip) == 5
    for turn, picture in enumerate(strip):
        with torch.no_grad():
            there = render_image(model, camera, latents, box(0.4 + 2 * math.pi * turn / 5))["rgb"].numpy()
        assert np.abs(picture / 255 - there).max() < 1 / 255 + 1e-3, turn
    assert np.abs(strip[0].astype(int) - strip[1]).max() > 40


def test_the_window_holds_the_car_all_the_way_around_and_no_more() -> None:
    camera = Camera(torch.tensor([720.0, 720.0, 30.0, 20.0]), 130, 80)
    box = box_from_kitti(torch.tensor([2.9, 1.6, 12.0]), torch.tensor([4.2, 1.5, 1.8]), torch.tensor(1.4))
    window = strip_camera(box, camera, 80, 60)
    points = torch.cat([window.project(turned.corners()) for turned in turns(box)])
    size = torch.tensor([80.0, 60.0])
    assert bool(((points > 0) & (points < size)).all())
    assert bool(((points.amax(dim=0) - points.amin(dim=0)) / size).max() > 0.93)
    torch.testing.assert_close(points.amax(dim=0) + points.amin(dim=0), size, rtol=0, atol=1e-2)
    rays = [at.unproject(at.project(box.corners()), torch.ones(8)) for at in (camera, window)]
    torch.testing.assert_close(rays[0], rays[1])
    near = box_from_kitti(torch.tensor([0.0, 1.6, 2.0]), torch.tensor([4.2, 1.5, 1.8]), torch.tensor(0.0))
    assert torch.equal(strip_camera(near, camera, 65, 40).intrinsics, camera.resize(65, 40).intrinsics)


@pytest.fixture(scope="module")
def track(tmp_path_factory: pytest.TempPathFactory) -> PatchCache:
    out: Path = tmp_path_factory.mktemp("track") / "store"
    synthesize(SynthConfig(out=out, cars=1, views=4, size=96, seed=3, tracks=True, workers=1))
    return PatchCache(open_store(out), 8)


def test_the_truth_of_a_strip_lies_where_the_strip_draws_the_car(track: PatchCache) -> None:
    """Each photograph's outline, moved into the strip's window, against the turned box's outline there."""
    names = track.store.patch_ids()
    frames, turned = [track[name] for name in names[:4]], [track[name] for name in names[4:]]
    photo = frames[2]
    found = true_views([photo, *turned], photo.box)
    assert [view.patch_id for view in found if view is not None] == [photo.patch_id, *names[4:]]
    assert true_views(turned, frames[0].box) == [None] * 19, "another frame of the drive stands elsewhere"
    window = strip_camera(photo.box, photo.camera, 80, 60)
    for view, box in zip(found, turns(photo.box), strict=True):
        assert view is not None
        seen = seen_by(view, window)
        rows, columns = np.nonzero((seen < 250).any(axis=-1))
        ends = window.project(box.corners())
        low, high = ends.amin(dim=0), ends.amax(dim=0)  # a body touches its box's outline within some pixels, inside
        drawn = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        outline = np.array([*low.tolist(), *high.tolist()])
        inside = np.array([1, 1, -1, -1]) * (drawn - outline)
        assert (inside > -1.1).all(), inside
        assert (inside < 9).all(), inside


def test_a_photograph_seen_by_its_own_camera_is_itself_cut_out(track: PatchCache) -> None:
    patch = track[track.store.patch_ids()[0]]
    is_car = (patch.mask == MaskValue.CAR).numpy()
    truth = np.where(is_car[..., None], patch.rgb.numpy(), 0).astype(int)
    inner = is_car.copy()
    inner[1:-1, 1:-1] &= is_car[:-2, 1:-1] & is_car[2:, 1:-1] & is_car[1:-1, :-2] & is_car[1:-1, 2:]
    inner[[0, -1]] = inner[:, [0, -1]] = False

    def error(x: int, y: int) -> float:
        height, width = is_car.shape
        seen = seen_by(patch, patch.camera.crop(x, y, width, height), background=0.0)
        return float(np.abs(seen - truth)[inner].mean())

    for x, y in ((1, 0), (0, 1)):  # what is half a pixel off is as near to one neighbour as to itself
        one, other = error(x, y), error(-x, -y)
        assert error(0, 0) < 0.6 * min(one, other)
        assert 0.8 < one / other < 1.25
