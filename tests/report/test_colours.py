import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from carstudio.report.colours import NO_DEPTH, colour_depth, turbo

RAMP = np.linspace(0, 1, 256, dtype=np.float32).reshape(16, 16)


def by_matplotlib(values: np.ndarray, name: str, low: float, high: float) -> np.ndarray:
    """Its own way from numbers to bytes."""
    return ScalarMappable(Normalize(low, high, clip=True), name).to_rgba(values, bytes=True)[..., :3]


def test_turbo_is_matplotlibs_and_opencvs() -> None:
    colours = turbo(RAMP).astype(int)
    assert np.abs(colours - by_matplotlib(RAMP, "turbo", 0, 1)).max() <= 1  # to_rgba cuts where we round
    indices = np.round(RAMP * 255).astype(np.uint8)
    opencvs = cv2.applyColorMap(indices, cv2.COLORMAP_TURBO)[..., ::-1].astype(int)
    assert np.abs(colours - opencvs).max() <= 2


def test_turbo_clips_and_takes_nan_for_nothing() -> None:
    values = np.array([[-1.0, 0.0, np.nan, 1.0, 7.0, np.inf]], np.float32)
    colours = turbo(values)[0]
    assert (colours[[1, 2]] == colours[0]).all()
    assert (colours[[4, 5]] == colours[3]).all()


def test_depth_is_viridis_from_far_to_near() -> None:
    depth = (5 + 10 * RAMP).astype(np.float32)
    colours = colour_depth(depth, near_m=5.0, far_m=15.0).astype(int)
    expected = by_matplotlib(-depth, "viridis", -15, -5).astype(int)
    assert np.abs(colours - expected).max() <= 2  # one table entry where rounding falls the other way
    assert (np.diff(colours.reshape(-1, 3)[:, 1]) <= 0).all()  # green falls all the way: no colour means two depths


def test_depth_beyond_its_range_has_the_ends_colours() -> None:
    colours = colour_depth(np.array([[1.0, 5.0, 10.0, 99.0]], np.float32), near_m=5.0, far_m=10.0)[0]
    yellow, violet = (np.round(255 * np.array(matplotlib.colormaps["viridis"](end)[:3])) for end in (1.0, 0.0))
    assert (colours[:2] == yellow).all()
    assert (colours[2:] == violet).all()


def test_without_a_range_the_outermost_fiftieths_do_not_count() -> None:
    """One wild pixel in a thousand does not swallow the contrast of the others."""
    depth = np.linspace(10, 20, 1000, dtype=np.float32).reshape(25, 40)
    plain = colour_depth(depth)
    wild = depth.copy()
    wild[0, 0], wild[24, 39] = 0.5, 500.0
    assert np.abs(colour_depth(wild).astype(int)[1:24] - plain.astype(int)[1:24]).max() <= 4
    low, high = np.sort(depth.ravel())[[20, 979]]  # ranks of 2 % and 98 %
    close = colour_depth(depth, near_m=float(low), far_m=float(high)).astype(int)
    assert np.abs(close - plain).max() <= 4


@pytest.mark.parametrize("nothing", [np.nan, 0.0, -1.0, np.inf])
def test_pixels_without_depth_are_almost_black(nothing: float) -> None:
    depth = np.array([[nothing, 5.0], [6.0, nothing]], np.float32)
    colours = colour_depth(depth)
    assert (colours[[0, 1], [0, 1]] == NO_DEPTH).all()
    assert (colours[[0, 1], [1, 0]] != NO_DEPTH).any(axis=-1).all()
    assert (colour_depth(np.full((2, 2), nothing, np.float32)) == NO_DEPTH).all()


def test_a_flat_depth_is_no_division_by_zero() -> None:
    with np.errstate(all="raise"):
        colours = colour_depth(np.full((2, 3), 7.0, np.float32))
    assert (colours == colours[0, 0]).all()
