"""DD3D's decoding against loops in float64, labels that are encoded and found again, KITTI's text."""

import math
from dataclasses import fields

import numpy as np
import pytest
import torch

from carstudio.dataset.sources.kitti_format import parse_labels
from carstudio.errors import InputError
from carstudio.geometry.box3d import box_from_kitti
from carstudio.geometry.camera import Camera
from carstudio.perception.dd3d.adapter import as_seen, to_photo
from carstudio.perception.dd3d.decoding import (
    Detections,
    Selection,
    candidates,
    egocentric_from_allocentric,
    metric_depth,
    place_in_space,
)
from carstudio.perception.dd3d.heads import HeadOutputs
from carstudio.perception.dd3d.kitti import result_text
from carstudio.perception.dd3d.model import KITTI_CLASSES
from carstudio.perception.results import Photo
from oracles import dd3d_slow as slow
from perception.dd3d_encoding import CHANNELS, Said, say, silent_outputs

CANONICAL = torch.tensor(list(KITTI_CLASSES.values()))
CAMERA = (700.0, 650.0, 90.0, 60.0)
STRIDES, GRIDS = (8, 16), ((7, 11), (4, 6))


def made_up(photos: int, seed: int = 0) -> list[HeadOutputs]:
    generator = torch.Generator().manual_seed(seed)

    def draw(name: str, rows: int, columns: int) -> torch.Tensor:
        values = torch.randn(photos, CHANNELS[name], rows, columns, generator=generator)
        shift, spread = {"logits": (-2.5, 1.5), "box2d": (20, 5), "depth": (20, 25), "center": (0, 9)}.get(name, (0, 1))
        return values * spread + shift

    return [HeadOutputs(**{name: draw(name, *grid) for name in CHANNELS}) for grid in GRIDS]


def batch_camera(photos: int) -> Camera:
    return Camera(torch.tensor([CAMERA] * photos), 88, 64)


@pytest.mark.parametrize("most", [1000, 20])
def test_candidates_equal_loops_over_cells(most: int) -> None:
    outputs = made_up(2)
    found = candidates(outputs, STRIDES, batch_camera(2), CANONICAL, Selection(most_per_level=most))
    for photo in range(2):
        levels = [
            {field.name: getattr(level, field.name)[photo].numpy() for field in fields(level)} for level in outputs
        ]
        expected = slow.decode(levels, STRIDES, CAMERA, CANONICAL.numpy(), most=most)
        ours = found[photo]
        assert 30 < len(expected) < 420  # some cells are candidates, others not
        for name in ("level", "cell", "kind"):
            assert getattr(ours, name).tolist() == [box[name] for box in expected]
        for name in ("box2d", "score_2d", "score_3d", "projected_center", "center", "size"):
            np.testing.assert_allclose(getattr(ours, name), [box[name] for box in expected], rtol=2e-5, atol=2e-5)
        quaternions = [slow.quaternion_of(box["rotation"]) for box in expected]
        same = (ours.quaternion.double() * torch.tensor(np.array(quaternions))).sum(dim=-1).abs()  # q and -q turn alike
        np.testing.assert_allclose(same, 1, atol=1e-6)
        assert (ours.quaternion[:, 0] >= 0).all()
        depths = ours.center[:, 2]
        assert (depths == 0.1).any() or most == 20
        assert (depths == 80.0).any() or most == 20


def test_a_photo_without_a_candidate() -> None:
    found = candidates(made_up(1), STRIDES, batch_camera(1), CANONICAL, Selection(least_score=1.0))
    assert len(found[0]) == 0
    assert to_photo(found[0], Camera(torch.tensor(CAMERA), 88, 64), photo_of(88, 64)) == []


def photo_of(width: int, height: int, **more: object) -> Photo:
    image = np.zeros((height, width, 3), np.uint8)
    return Photo(image=image, frame_id="a", path="a.png", intrinsics=CAMERA, **more)  # type: ignore[arg-type]


def test_egocentric_is_a_camera_pointed_at_the_object() -> None:
    rays = np.random.default_rng(0).normal(0, 1, (50, 3)) + np.array([0, 0, 2.5])
    found = egocentric_from_allocentric(torch.from_numpy(rays))
    np.testing.assert_allclose(found, [slow.pointed_at(ray) for ray in rays], atol=1e-12)
    np.testing.assert_allclose(found @ torch.tensor([0.0, 0, 1]).double(), rays / np.linalg.norm(rays, axis=1)[:, None])


def test_depth_is_that_of_equal_size_in_the_image() -> None:
    """A car of height h at z is f h / z px high: the same picture by a lens of another focal length is from f / z."""
    raw = torch.tensor([20.0, 35.0])
    for focal in (250.0, 721.5377, 3000.0):
        camera = Camera(torch.tensor([focal, focal, 0.0, 0.0]), 10, 10)
        expected = (raw / 500 * focal / math.sqrt(2)).clamp(0.1, 80)
        np.testing.assert_allclose(metric_depth(raw, camera), expected, rtol=1e-6)
    doubled = Camera(torch.tensor([721.5377, 721.5377, 600.0, 180.0]), 1242, 375).resize(2484, 750)
    single = Camera(torch.tensor([721.5377, 721.5377, 600.0, 180.0]), 1242, 375)
    torch.testing.assert_close(metric_depth(raw, doubled), 2 * metric_depth(raw, single))


def test_a_wrong_focal_length_moves_a_box_in_depth_alone() -> None:
    """(u - cx) / f grows as much less as z grows more: x and y stay (what `bench/focal_error.py` finds on labels)."""
    truth = torch.tensor([[-3.0, 1.1, 14.0], [2.0, 0.6, 33.0]], dtype=torch.float64)
    own = Camera(torch.tensor(CAMERA, dtype=torch.float64), 88, 64)
    raw = truth[:, 2] * 500 * math.hypot(1 / CAMERA[0], 1 / CAMERA[1])
    for factor in (0.7, 1.0, 1.3):
        wrong = Camera(own.intrinsics * torch.tensor([factor, factor, 1.0, 1.0]), 88, 64)
        _, center = place_in_space(torch.eye(4)[:2].double(), raw, own.project(truth), wrong)
        np.testing.assert_allclose(center, truth * torch.tensor([1.0, 1.0, factor]), rtol=1e-6)


def encoded(rotation: np.ndarray, center: np.ndarray, size: tuple[float, float, float], kind: int) -> list[HeadOutputs]:
    """One cell says this box, the others say nothing."""
    outputs = [silent_outputs(*grid) for grid in GRIDS]
    say(outputs[0], 8, CAMERA, Said(kind, rotation, center, size, (20.0, 14.0, 64.0, 38.0)), (3, 5))
    return outputs


@pytest.mark.parametrize("yaw", [-3.0, -1.5708, -0.4, 0.0, 1.2, 3.1])
def test_an_encoded_label_is_found_again(yaw: float) -> None:
    """The whole way to our axes; and KITTI's text of it, read by our own reader."""
    center, size = np.array([-2.0, 0.7, 17.0]), (4.1, 1.6, 1.7)
    (found,) = candidates(
        encoded(slow.kitti_object_rotation(yaw), center, size, 0), STRIDES, batch_camera(1), CANONICAL, Selection()
    )
    assert len(found) == 1
    photo = photo_of(176, 64, camera_offset=(0.06, 0.0, 0.003))
    (box,) = to_photo(found, Camera(torch.tensor(CAMERA), 88, 64), photo)
    expected = box_from_kitti(torch.tensor([-2.0, 0.7 + 0.8, 17.0]), torch.tensor(size), torch.tensor(yaw))
    np.testing.assert_allclose(box.center, expected.center + torch.tensor([0.06, 0.0, 0.003]), atol=1e-4)
    np.testing.assert_allclose(box.size, size, rtol=1e-5)
    assert math.cos(box.yaw - yaw) == pytest.approx(1, abs=1e-6)
    assert (box.type, box.score) == ("Car", pytest.approx(1, abs=1e-6))
    assert box.box2d == pytest.approx((40.0, 14.0, 128.0, 38.0))  # twice as wide as seen
    (label,) = parse_labels(result_text(found), name="ours")
    assert label.type == "Car"
    np.testing.assert_allclose(label.size, size, atol=0.006)
    assert math.cos(label.yaw_rad - yaw) == pytest.approx(1, abs=1e-4)
    assert label.score == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose([float(word) for word in label.line.split()[11:14]], [-2.0, 1.5, 17.0], atol=0.006)


def test_people_are_no_vehicles_and_boxes_end_with_the_photo() -> None:
    center, size = np.array([0.0, 0.0, 9.0]), (0.9, 1.8, 0.6)
    seen = Camera(torch.tensor(CAMERA), 88, 64)
    (found,) = candidates(
        encoded(slow.kitti_object_rotation(0.3), center, size, 1), STRIDES, batch_camera(1), CANONICAL, Selection()
    )
    assert to_photo(found, seen, photo_of(88, 64)) == []
    (found,) = candidates(
        encoded(slow.kitti_object_rotation(0.3), center, (4.0, 1.5, 1.6), 0),
        STRIDES,
        batch_camera(1),
        CANONICAL,
        Selection(),
    )
    shifted = Detections(**{**vars(found), "box2d": torch.tensor([[-5.0, 10.0, 400.0, 30.0]])})
    (box,) = to_photo(shifted, seen, photo_of(88, 64))
    assert box.box2d == (0.0, 10.0, 88.0, 30.0)
    outside = Detections(**{**vars(found), "box2d": torch.tensor([[-50.0, 10.0, -4.0, 30.0]])})
    assert to_photo(outside, seen, photo_of(88, 64)) == []


def test_a_leaning_box_keeps_its_rotation() -> None:
    center = np.array([1.0, 0.5, 8.0])
    leaning = slow.turn(0, 0.2) @ slow.kitti_object_rotation(0.2)  # a camera that looks down
    (found,) = candidates(
        encoded(leaning, center, (4.0, 1.5, 1.6), 0), STRIDES, batch_camera(1), CANONICAL, Selection()
    )
    (box,) = to_photo(found, Camera(torch.tensor(CAMERA), 88, 64), photo_of(88, 64))
    assert box.rotation is not None
    axes = slow.matrix_of(np.array(box.rotation))
    np.testing.assert_allclose(axes[:, 0], leaning[:, 0], atol=1e-5)  # front
    np.testing.assert_allclose(axes[:, 1], -leaning[:, 2], atol=1e-5)  # down
    np.testing.assert_allclose(axes[:, 2], leaning[:, 1], atol=1e-5)  # left


def test_what_the_network_sees() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (60, 90, 3)).astype(np.uint8)
    pixels, camera = as_seen(image, Camera(torch.tensor([80.0, 80.0, 45.0, 30.0]), 90, 60))
    assert pixels.shape == (3, 384, 576)
    assert camera.intrinsics.tolist() == [80 * 6.4, 80 * 6.4, 45 * 6.4, 30 * 6.4]
    tall, _ = as_seen(image.transpose(1, 0, 2).copy(), Camera(torch.tensor([80.0, 80.0, 30.0, 45.0]), 60, 90))
    assert tall.shape == (3, 576, 384)
    plain = np.full((50, 70, 3), (10, 20, 30), np.uint8)
    pixels, _ = as_seen(plain, Camera(torch.tensor([80.0, 80.0, 35.0, 25.0]), 70, 50))
    assert pixels[:, 0, 0].tolist() == [30, 20, 10]  # BGR
    with pytest.raises(InputError, match="2000 x 60 px"):
        as_seen(np.zeros((60, 2000, 3), np.uint8), Camera(torch.tensor([80.0, 80.0, 45.0, 30.0]), 2000, 60))
