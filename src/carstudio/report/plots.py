"""Curves and bars as PNG or SVG bytes, drawn with matplotlib's objects (no pyplot, no global state).

The background is transparent and the ink a middle grey that reads on white and on black, so that one picture serves a
light and a dark page.
"""

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

PlotFormat = Literal["png", "svg"]

INK = "#7d8590"
GRID = "#7d859033"
BLUE = "#3b82f6"
TEAL = "#14a38b"
AMBER = "#e8833a"
LINES = (BLUE, TEAL, AMBER, INK, "#a855f7", "#e5484d", "#8d6e63", "#db2777")
PIXELS_PER_INCH = 160
SMOOTHING = 0.9  # weight of the past in the running mean drawn over a noisy curve


def learning_curve(rows: Sequence[Mapping[str, Any]], *, style: PlotFormat = "png") -> bytes:
    """Loss (logarithmic) and PSNR over training steps, from the rows of a training log: step, loss, psnr.

    Rows may lack a figure or hold null; the raw curve is drawn faintly below its running mean.
    """
    figure = Figure(figsize=(8.0, 2.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    _curve(left, *_series(rows, "loss"), title="Loss", colour=BLUE)
    _curve(right, *_series(rows, "psnr"), title="PSNR (dB)", colour=TEAL)
    if any(value > 0 for value in _series(rows, "loss")[1]):
        left.set_yscale("log")
    return figure_bytes(figure, style)


def bars(
    values: Mapping[str, float],
    *,
    title: str,
    intervals: Mapping[str, tuple[float, float]] | None = None,
    style: PlotFormat = "png",
) -> bytes:
    """One horizontal bar per name, the figure written beside it; `intervals` (low, high) are drawn as whiskers."""
    figure = Figure(figsize=(8.0, 0.7 + 0.38 * len(values)), layout="constrained")
    axes = figure.subplots()
    names = list(values)[::-1]
    axes.barh(names, [values[name] for name in names], color=BLUE, height=0.62)
    for row, name in enumerate(names):
        low, high = (intervals or {}).get(name, (values[name], values[name]))
        if intervals and name in intervals:
            axes.plot([low, high], [row, row], color=INK, linewidth=1.4)
        axes.annotate(f"{values[name]:.4g}", (max(high, values[name]), row), (5, 0), textcoords="offset points",
                      va="center", color=INK, fontsize=9)  # fmt: skip
    dress(axes, title)
    axes.grid(visible=False, axis="y")
    axes.margins(x=0.1)
    return figure_bytes(figure, style)


class Point(NamedTuple):
    """A value with its interval at a place on the x axis."""

    x: float
    value: float
    low: float
    high: float


def curves(
    series: Mapping[str, Sequence[Point]],
    *,
    title: str,
    x: str,
    families: Sequence[str] = (),
    style: PlotFormat = "png",
    ground: str = "white",
) -> bytes:
    """Lines through points with their intervals, over a logarithmic x axis; `ground` is the paper's colour.

    Series of one family (one name per series) have its colour, all but its first are dashed. A single point among
    longer series, to compare them with, is a dotted line all across.
    """
    figure = Figure(figsize=(8.0, max(3.4, 0.6 + 0.28 * len(series))), layout="constrained", facecolor=ground)
    axes = figure.subplots()
    family_of = dict(zip(series, families or series, strict=True))
    order, longest = list(dict.fromkeys(family_of.values())), max(len(points) for points in series.values())
    seen: set[str] = set()
    for name, points in series.items():
        family = family_of[name]
        colour, line = LINES[order.index(family) % len(LINES)], "--" if family in seen else "-"
        seen.add(family)
        if len(points) < min(longest, 2):
            axes.axhline(points[0].value, color=colour, linewidth=1.6, linestyle=":", label=name)
            continue
        values = [point.value for point in points]
        axes.plot([point.x for point in points], values, line, color=colour, marker="o", markersize=4, linewidth=1.6,
                  label=name)  # fmt: skip
        axes.vlines([p.x for p in points], [p.low for p in points], [p.high for p in points], color=colour, alpha=0.35)
    axes.set_xscale("log")
    places = sorted({point.x for points in series.values() for point in points})
    axes.set_xticks(places, [f"{place:,.0f}" for place in places])
    axes.minorticks_off()
    dress(axes, title)
    axes.set_xlabel(x, color=INK, fontsize=9)
    figure.legend(fontsize=8, frameon=False, labelcolor=INK, loc="outside right upper", handlelength=3.4)
    return figure_bytes(figure, style, is_transparent=False)


def _series(rows: Sequence[Mapping[str, Any]], name: str) -> tuple[list[float], list[float]]:
    """Steps and values of one figure, without what is missing or not finite."""
    pairs = [(row["step"], row.get(name)) for row in rows]
    kept = [(float(step), float(value)) for step, value in pairs if value is not None and math.isfinite(value)]
    return [step for step, _ in kept], [value for _, value in kept]


def running_mean(values: Sequence[float], keep: float = SMOOTHING) -> list[float]:
    """Exponential running mean, corrected for its start (the first value is itself)."""
    total, weight, means = 0.0, 0.0, []
    for value in values:
        total, weight = keep * total + (1 - keep) * value, keep * weight + (1 - keep)
        means.append(total / weight)
    return means


def _curve(axes: Axes, steps: Sequence[float], values: Sequence[float], *, title: str, colour: str) -> None:
    if len(values) > 20:  # fewer points need no smoothing
        axes.plot(steps, values, color=colour, linewidth=0.8, alpha=0.3)
        axes.plot(steps, running_mean(values), color=colour, linewidth=1.8)
    else:
        axes.plot(steps, values, color=colour, linewidth=1.8, marker="o", markersize=3)
    if not values:
        axes.text(0.5, 0.5, "not logged", transform=axes.transAxes, ha="center", va="center", color=INK)
    dress(axes, title)
    axes.set_xlabel("training step", color=INK, fontsize=9)


def dress(axes: Axes, title: str) -> None:
    """Give a plot its title and the look of all our plots."""
    axes.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
    axes.tick_params(colors=INK, labelsize=9, which="both")
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.set_facecolor("none")
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(INK)


def figure_bytes(figure: Figure, style: PlotFormat, *, is_transparent: bool = True) -> bytes:
    """The same figure gives the same bytes: no date, no random ids."""
    buffer = io.BytesIO()
    metadata: dict[str, Any] = {"Date": None} if style == "svg" else {"Software": None}
    with matplotlib.rc_context({"svg.hashsalt": "carstudio"}):
        FigureCanvasAgg(figure)
        figure.savefig(buffer, format=style, dpi=PIXELS_PER_INCH, transparent=is_transparent, metadata=metadata)
    return buffer.getvalue()
