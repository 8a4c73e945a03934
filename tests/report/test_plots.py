"""Curves and bars: the figures given are the figures drawn; what is missing is a gap, not an error."""

import xml.etree.ElementTree as ElementTree
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from carstudio.report.plots import BLUE, INK, TEAL, Point, bars, curves, learning_curve, running_mean

SVG = "{http://www.w3.org/2000/svg}"


def pixels(png: bytes) -> np.ndarray:
    return np.array(Image.open(BytesIO(png)).convert("RGBA"))


def is_colour(picture: np.ndarray, colour: str) -> np.ndarray:
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return (np.abs(picture[..., :3].astype(int) - rgb).max(axis=-1) < 12) & (picture[..., 3] > 200)


def rows(count: int) -> list[dict[str, float | int]]:
    return [{"step": 10 * i, "loss": 1.0 / (i + 1), "psnr": 10.0 + 0.1 * i} for i in range(count)]


@pytest.mark.parametrize("count", [5, 60])
def test_loss_falls_on_the_left_and_psnr_rises_on_the_right(count: int) -> None:
    picture = pixels(learning_curve(rows(count)))
    middle = picture.shape[1] // 2
    loss, psnr = is_colour(picture, BLUE), is_colour(picture, TEAL)
    assert not loss[:, middle:].any()
    assert not psnr[:, :middle].any()
    for curve, goes_up in ((loss, False), (psnr, True)):
        y, x = np.nonzero(curve)
        first, last = y[x < x.min() + 5].mean(), y[x > x.max() - 5].mean()
        assert bool(last < first) is goes_up  # rows count downwards


def test_the_ground_is_transparent() -> None:
    picture = pixels(learning_curve(rows(30)))
    assert (picture[..., 3] == 0).mean() > 0.8


@pytest.mark.parametrize(
    "broken", [{"loss": None}, {"loss": float("nan")}, {"psnr": float("inf")}, {"loss": 0.0}, {"psnr": None}]
)
def test_gaps_in_the_log_are_no_error(broken: dict[str, float | None]) -> None:
    log = rows(30)
    log[7] = {**log[7], **broken}
    assert is_colour(pixels(learning_curve(log)), BLUE).sum() > 50


@pytest.mark.parametrize("log", [[], [{"step": 1}], [{"step": 1, "loss": None, "psnr": float("nan")}]])
def test_an_empty_log_says_so(log: list[dict[str, float | None]]) -> None:
    picture = pixels(learning_curve(log))
    assert not is_colour(picture, BLUE).any()
    height, width = picture.shape[:2]
    for half in (0.25, 0.75):  # words in the middle of either plot
        x = int(half * width)
        assert is_colour(picture[height // 3 : 2 * height // 3, x - 60 : x + 60], INK).sum() > 100


def test_a_running_mean_is_the_weighted_mean_of_the_past() -> None:
    rng = np.random.default_rng(0)
    values = rng.random(40).tolist()
    for i, mean in enumerate(running_mean(values, keep=0.8)):
        weights = 0.8 ** np.arange(i, -1, -1.0)
        assert mean == pytest.approx(np.average(values[: i + 1], weights=weights), rel=1e-12)


def test_bars_are_as_long_as_their_figures() -> None:
    picture = pixels(bars({"a": 1.0, "b": 2.0, "c": 4.0}, title="Speed"))
    is_bar = is_colour(picture, BLUE)
    lengths = [int(n) for n in is_bar.sum(axis=1) if n > 20]
    edges = np.flatnonzero(np.diff(is_bar.sum(axis=1) > 20))
    assert len(edges) == 6  # three bars
    a, b, c = (is_bar[(edges[i] + edges[i + 1]) // 2].sum() for i in (0, 2, 4))
    assert b / a == pytest.approx(2, rel=0.03)
    assert c / a == pytest.approx(4, rel=0.03)  # top to bottom in the order given
    assert max(lengths) == pytest.approx(c, abs=2)


def test_intervals_are_drawn_from_low_to_high() -> None:
    picture = pixels(bars({"a": 2.0, "b": 4.0}, title="t", intervals={"a": (1.0, 3.0)}))
    is_bar = is_colour(picture, BLUE)
    rows_of_bars = np.flatnonzero(is_bar.sum(axis=1) > 20)
    middle = picture[rows_of_bars[0] : rows_of_bars[0] + 60]  # the upper bar
    start = int(np.nonzero(is_bar.any(axis=0))[0][0])
    unit = (np.nonzero(is_bar.any(axis=0))[0][-1] + 1 - start) / 4.0
    row = max(range(len(middle)), key=lambda i: is_colour(middle[i : i + 1], INK).sum())
    ink = np.flatnonzero(is_colour(middle[row : row + 1], INK)[0][start + 5 :]) + start + 5
    whisker = ink[: int(np.argmax(np.diff(ink, append=ink[-1] + 9) > 1)) + 1]
    assert (whisker[0] - start) / unit == pytest.approx(1.0, abs=0.05)
    assert (whisker[-1] - start) / unit == pytest.approx(3.0, abs=0.05)


def test_the_same_figures_give_the_same_bytes_and_sound_svg() -> None:
    for style in ("png", "svg"):
        assert learning_curve(rows(25), style=style) == learning_curve(rows(25), style=style)
        assert bars({"<a & b>": 1.5}, title="t", style=style) == bars({"<a & b>": 1.5}, title="t", style=style)
    root = ElementTree.fromstring(bars({"<a & b>": 1.5}, title="<t>", style="svg"))
    assert root.tag == f"{SVG}svg"


def test_a_family_shares_a_colour_and_a_single_point_goes_all_across() -> None:
    one, two = ([Point(x, value, value, value) for x in (1, 10, 100)] for value in (1.0, 2.0))
    alone = [Point(1, 1.5, 1.5, 1.5)]
    series = {"a: latents": one, "a: field": two, "b": alone}
    picture = pixels(curves(series, title="PSNR", x="steps", families=("a", "a", "b")))
    plot = picture[:, : round(0.75 * picture.shape[1])]  # the legend stands to the right
    lines = is_colour(plot, BLUE)
    in_rows = lines.sum(axis=1)
    solid, dashed = in_rows[in_rows.argmax()], in_rows[: in_rows.argmax() - 40].max()  # 2.0 is the upper one
    assert 0.5 * solid < dashed < 0.9 * solid
    columns = np.flatnonzero(is_colour(plot, TEAL).any(axis=0))
    assert np.ptp(columns) > np.ptp(np.flatnonzero(lines.any(axis=0))), "it reaches beyond the last point"
    apart = pixels(curves(series, title="PSNR", x="steps"))
    assert is_colour(apart, TEAL).sum() > 3 * is_colour(picture, TEAL).sum(), "without families each has its own"
