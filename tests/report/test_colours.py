"""Turbo and depth colours against OpenCV's tables of the same maps and the published ends."""

import cv2
import numpy as np
import pytest

from carstudio.report.colours import NO_DEPTH, colour_depth, turbo

RAMP = np.linspace(0.0, 1.0, 256, dtype=np.float32)[None]


def by_opencv(kind: int) -> np.ndarray:
    """Row of 256 colours, RGB."""
    return cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], kind)[0, :, ::-1].astype(int)


def test_turbo_is_opencvs_turbo() -> None:
    assert np.abs(turbo(RAMP)[0].astype(int) - by_opencv(cv2.COLORMAP_TURBO)).max() <= 2  # rounding of the tables


def test_turbo_clips_and_shows_nan_as_nothing() -> None:
    picture = turbo(np.array([[-3.0, 0.0, np.nan, 1.0, 7.0]], np.float32))[0]
    assert (picture[:3] == picture[0]).all()
    assert (picture[3:] == picture[3]).all()
    assert tuple(picture[0]) == (48, 18, 59)  # the two ends as published
    assert tuple(picture[3]) == (122, 4, 3)


def test_depth_is_opencvs_viridis_from_near_to_far() -> None:
    depth = 5.0 + 10.0 * RAMP[:, ::-1]  # far first, so that the row runs from dark to bright
    picture = colour_depth(depth, near_m=5.0, far_m=15.0)[0].astype(int)
    assert np.abs(picture - by_opencv(cv2.COLORMAP_VIRIDIS)).max() <= 2


def test_depth_takes_its_range_from_the_picture() -> None:
    """2nd and 98th percentile: one wild value changes the ends by little, and is drawn like the end."""
    depth = np.linspace(8.0, 12.0, 1000, dtype=np.float32).reshape(20, 50)
    wild = depth.copy()
    wild[-1, -1] = 500.0
    plain, with_wild = colour_depth(depth).astype(int), colour_depth(wild).astype(int)
    assert np.abs(plain - with_wild).max() <= 3
    assert (colour_depth(depth)[0, :5] == colour_depth(depth)[0, 0]).all()  # below the 2nd percentile: all nearest


@pytest.mark.parametrize("nothing", [np.nan, 0.0, -1.0, np.inf])
def test_no_depth_is_almost_black(nothing: float) -> None:
    depth = np.array([[nothing, 9.0], [9.0, 9.0]], np.float32)
    picture = colour_depth(depth)
    assert tuple(picture[0, 0]) == NO_DEPTH
    assert picture[0, 1].max() > 2 * max(NO_DEPTH)
    assert (colour_depth(np.full((2, 3), nothing, np.float32)) == NO_DEPTH).all()


def test_one_depth_all_over_is_no_division_by_zero() -> None:
    assert np.unique(colour_depth(np.full((4, 4), 7.0, np.float32)).reshape(-1, 3), axis=0).shape == (1, 3)
