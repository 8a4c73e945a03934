"""What the camera did to the photographs: blur and noise put in are found again; gains only where light differs."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from carstudio.scene.drawing import read_photo
from carstudio.scene.matching import blur_of, gains_of, noise_of, sampled, sensor_of
from scene.toy_log import inserted, placed, toy_scene


def edges(sigma: float, noise: float = 0.0) -> np.ndarray:
    picture = np.full((240, 320), 60.0)
    picture[:, 80:160] = 190
    picture[100:, 220:] = 130
    big = cv2.resize(picture, None, fx=4, fy=4, interpolation=cv2.INTER_NEAREST)
    blurred = cv2.GaussianBlur(big, (0, 0), 4 * sigma)
    small = blurred.reshape(240, 4, 320, 4).mean(axis=(1, 3))
    small = small + np.random.default_rng(0).normal(0, noise * 255, small.shape)
    return np.clip(np.round(small), 0, 255).astype(np.uint8)[..., None].repeat(3, axis=2)


@pytest.mark.parametrize("sigma", [0.8, 1.5, 2.5])
def test_blur_is_found(sigma):
    assert blur_of(edges(sigma)) == pytest.approx(np.hypot(sigma, 0.29), rel=0.2)  # 0.29: a pixel's own width


@pytest.mark.parametrize("noise", [0.004, 0.012, 0.03])
def test_noise_is_found(noise):
    picture = np.clip(np.round(120 + np.random.default_rng(1).normal(0, noise * 255, (240, 320))), 0, 255)
    assert noise_of(picture.astype(np.uint8)[..., None].repeat(3, axis=2)) == pytest.approx(noise, rel=0.2)


def test_flat_pictures_have_neither():
    flat = np.full((64, 64, 3), 128, np.uint8)
    assert blur_of(flat) == 0.0
    assert noise_of(flat) == 0.0
    assert sensor_of((), lambda frame: flat).noise == 0.0


def test_few_frames_are_looked_at(tmp_path):
    scene = toy_scene(tmp_path, frames=9, tracks={"1": [placed(2.0, 20.0)] * 9})
    assert [frame.index for frame in sampled(scene.frames)] == [0, 2, 4, 6, 8]


def test_a_replayed_car_is_drawn_as_it_is(tmp_path):
    scene = toy_scene(tmp_path, frames=2)
    replayed = scene.with_track(replace(scene.tracks["1"], is_drawn=True))
    assert gains_of(scene, replayed, frozenset(), lambda frame: read_photo(scene.root, frame)) == {}


def test_a_foreign_car_takes_on_the_light_of_the_road_and_the_shade(tmp_path):
    scene = toy_scene(tmp_path, frames=2)
    boxes = {i: placed(0.2, 10.0) for i in range(2)}
    edited = inserted(scene, "9", boxes)

    def dark(frame):
        return (read_photo(scene.root, frame) * 0.6).astype(np.uint8)

    def shaded(frame):  # only around the new place
        photo = read_photo(scene.root, frame).copy()
        photo[45:, 55:105] = (photo[45:, 55:105] * 0.4).astype(np.uint8)
        return photo

    bright = gains_of(scene, edited, frozenset({"9"}), lambda frame: read_photo(scene.root, frame))
    dim = gains_of(scene, edited, frozenset({"9"}), dark)["9"]
    assert np.mean(dim) < 0.7 * np.mean(bright.get("9", (1.0, 1.0, 1.0)))
    assert np.mean(gains_of(scene, edited, frozenset(), shaded)["9"]) < 0.9
