"""Mitsuba's pictures against the exact rays: the same car in the same place, in about the same light."""

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="the extra `photo` is not installed")

from carstudio.synthetic.cars import draw_car  # after the skip
from carstudio.synthetic.mitsuba_renderer import PathTracer, without_fireflies
from carstudio.synthetic.photographs import RayCaster, draw_photographs


def photographs(renderer: object, size: int = 48) -> list[np.ndarray]:
    taken = draw_photographs(
        draw_car(np.random.default_rng(7)),
        seed=(3, 0),
        num_views=2,
        size_px=size,
        cameras="mixed",
        renderer=renderer,  # type: ignore[arg-type]  # either of the two
    )
    return [photo for view in taken for photo in (view.image, view.mask, view.depth_m)]


def test_truth_is_the_ray_casters_and_colours_are_close() -> None:
    ours, theirs = photographs(RayCaster()), photographs(PathTracer("scalar_rgb"))
    for index in (1, 2, 4, 5):
        np.testing.assert_array_equal(ours[index], theirs[index])
    for index in (0, 3):
        mask = ours[index + 1]
        one, other = ours[index].astype(float), theirs[index].astype(float)
        assert not np.array_equal(one, other)
        for pixels in (mask, ~mask):  # a mirrored, shifted or black picture would be far away
            correlation = np.corrcoef(one[pixels].ravel(), other[pixels].ravel())[0, 1]
            assert correlation > 0.8, correlation
            assert abs(one[pixels].mean() - other[pixels].mean()) < 25
        shifted = np.roll(other, 6, axis=1)
        assert np.abs(one - other).mean() < 0.6 * np.abs(one - shifted).mean()


def test_the_same_seed_gives_the_same_pixels() -> None:
    first, second = (photographs(PathTracer("scalar_rgb"), size=24) for _ in range(2))
    np.testing.assert_array_equal(first[0], second[0])


def test_one_bright_pass_does_not_count_in_full() -> None:
    passes = np.full((4, 2, 2, 3), 0.5)
    passes[1, 0, 0] = 100.0
    mean = without_fireflies(passes)
    assert mean[0, 0, 0] == pytest.approx((3 * 0.5 + 1.05) / 4)
    assert mean[1, 1, 0] == 0.5
