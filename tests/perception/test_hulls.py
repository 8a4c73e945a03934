"""Outlines and masks: against matplotlib's point-in-polygon test, scipy's labels and closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from scipy import ndimage
from scipy.spatial import ConvexHull

from carstudio.perception.hulls import (
    allowed_pixels,
    clean_mask,
    convex_hull,
    enlarged_window,
    fill_hull,
    occluded_pixels,
    shrink,
)
from carstudio.perception.results import SegmentRequest, Window

WINDOW = Window(5, 3, 40, 30)


def request(hull: np.ndarray | None = None, *occluders: np.ndarray) -> SegmentRequest:
    image = np.zeros((60, 80, 3), np.uint8)
    return SegmentRequest(image=image, window=WINDOW, box2d=(5.0, 3.0, 44.9, 32.9), hull=hull, occluders=occluders)


@given(st.integers(0, 10_000), st.booleans())
def test_filled_pixels_are_those_whose_centre_is_inside(seed: int, is_reversed: bool) -> None:
    points = np.random.default_rng(seed).uniform((-10, -10), (70, 60), (12, 2))
    hull = convex_hull(points)
    exact = points[ConvexHull(points).vertices]
    v, u = np.mgrid[3:33, 5:45] + 0.5
    expected = Polygon(exact).contains_points(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(30, 40)
    found = fill_hull(hull[::-1] if is_reversed else hull, WINDOW)
    np.testing.assert_array_equal(found, expected)


def test_a_rectangle_fills_its_pixels_exactly() -> None:
    """Pixel centres at +0.5: [7, 10] x [4, 6] covers three columns and two rows, not four and three."""
    mask = fill_hull(np.array([[7.0, 4.0], [10.0, 4.0], [10.0, 6.0], [7.0, 6.0]]), WINDOW)
    rows, columns = np.nonzero(mask)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (1, 2, 2, 4)
    assert mask.sum() == 6


def test_degenerate_outlines_cover_nothing() -> None:
    for points in (np.zeros((0, 2)), np.ones((1, 2)), np.array([[0.0, 0.0], [50.0, 40.0]])):
        assert not fill_hull(convex_hull(points), WINDOW).any()


def test_shrinking_keeps_the_middle_and_scales_the_area() -> None:
    square = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 20.0], [10.0, 20.0]])
    small = shrink(square, 0.5)
    np.testing.assert_allclose(small, [[15, 12.5], [25, 12.5], [25, 17.5], [15, 17.5]])


def test_margin_widens_the_outline_by_that_many_pixels() -> None:
    square = np.array([[15.0, 13.0], [25.0, 13.0], [25.0, 23.0], [15.0, 23.0]])
    plain, wide = (allowed_pixels(request(square), margin, WINDOW) for margin in (0.0, 3.0))
    assert plain.sum() == 100
    columns = np.nonzero(wide.any(axis=0))[0]
    assert (columns.min(), columns.max()) == (10 - 3, 19 + 3)
    assert allowed_pixels(request(), 0.0, WINDOW).all()  # without a 3-D box: the 2-D box


def test_occluders_are_united() -> None:
    left = np.array([[5.0, 3.0], [15.0, 3.0], [15.0, 33.0], [5.0, 33.0]])
    right = left + np.array([30.0, 0.0])
    assert not occluded_pixels(request(), WINDOW).any()
    assert occluded_pixels(request(None, left, right), WINDOW).mean() == 0.5


@given(st.floats(-10, 70), st.floats(-10, 50), st.floats(1, 60), st.floats(1, 60), st.floats(1, 2))
def test_enlarged_window_holds_the_crop_and_stays_in_the_photo(
    x0: float, y0: float, width: float, height: float, factor: float
) -> None:
    left, top = max(0, int(x0)), max(0, int(y0))
    right, bottom = min(79, int(x0 + width)), min(59, int(y0 + height))
    if right < left or bottom < top:
        return
    crop = Window(left, top, right - left + 1, bottom - top + 1)
    asked = SegmentRequest(image=np.zeros((60, 80, 3), np.uint8), window=crop, box2d=(x0, y0, x0 + width, y0 + height))
    outer = enlarged_window(asked, factor)
    assert 0 <= outer.x0 <= crop.x0
    assert 0 <= outer.y0 <= crop.y0
    assert crop.x0 + crop.width <= outer.x0 + outer.width <= 80
    assert crop.y0 + crop.height <= outer.y0 + outer.height <= 60
    photo = np.arange(60 * 80).reshape(60, 80)
    np.testing.assert_array_equal(photo[outer.slices][crop.within(outer).slices], photo[crop.slices])


@given(st.integers(0, 10_000), st.floats(0.3, 0.7))
def test_clean_mask_against_a_slow_loop(seed: int, share: float) -> None:
    noise = np.random.default_rng(seed).random((24, 30))
    car = ndimage.uniform_filter(noise, 3) > np.quantile(ndimage.uniform_filter(noise, 3), share)
    expected = car.copy()
    labels, count = ndimage.label(car)
    sizes = [int((labels == i).sum()) for i in range(1, count + 1)]
    least = 0.1 * max(sizes)
    for i, size in enumerate(sizes, start=1):
        if size < least:
            expected[labels == i] = False
    holes, count = ndimage.label(~expected)
    filled = expected.copy()
    for i in range(1, count + 1):
        hole = holes == i
        is_edge = hole[0].any() or hole[-1].any() or hole[:, 0].any() or hole[:, -1].any()
        if hole.sum() < least and not is_edge:
            filled[hole] = True
    np.testing.assert_array_equal(clean_mask(car), filled)


@pytest.mark.parametrize("value", [True, False])
def test_clean_mask_leaves_a_uniform_mask(value: bool) -> None:
    mask = np.full((5, 6), value)
    np.testing.assert_array_equal(clean_mask(mask), mask)
