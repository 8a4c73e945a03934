"""How the values of many patches are distributed: histograms with thresholds, and the rose of viewing directions.

Kept and rejected patches are stacked in two colours; values that are not finite ("unknown") are left out and counted.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from carstudio.report.plots import AMBER, GRID, INK, TEAL, PlotFormat, dress, figure_bytes

PINK = "#ff3d9a"  # a threshold
BINS = 40
TAIL_PERCENT = 0.5  # values beyond these percentiles are counted in the outermost bins
ROSE_BINS = 36  # of 10 degrees
LEVELS = 8  # so many whole numbers get a bin each
_COLUMNS = 3

Values = Float[np.ndarray, " patch"]
Flags = Bool[np.ndarray, " patch"]


@dataclass(frozen=True, kw_only=True)
class Distribution:
    """One value of all patches. `thresholds` are drawn in; `limit_text` says what they ask for."""

    title: str
    values: Values
    is_kept: Flags
    thresholds: tuple[float, ...] = ()
    limit_text: str = ""


def bin_edges(values: Values, thresholds: Sequence[float] = (), bins: int = BINS) -> Float[np.ndarray, " _edges"]:
    """Equal bins over the finite values without their tails; all thresholds lie well inside, the first on an edge.

    Whole numbers that are few (levels of occlusion) get a bin each.
    """
    finite = values[np.isfinite(values)]
    whole = np.unique(finite)
    is_levels = 0 < len(whole) <= LEVELS and np.array_equal(whole, np.round(whole)) and np.ptp(whole) < LEVELS
    if is_levels and not len(thresholds):
        return np.arange(whole[0] - 0.5, whole[-1] + 1.0)
    low, high = np.percentile(finite, [TAIL_PERCENT, 100 - TAIL_PERCENT]) if len(finite) else (0.0, 1.0)
    low, high = min([low, *thresholds]), max([high, *thresholds])
    if high - low < 1e-9 * max(1.0, abs(low)):
        low, high = low - 0.5, high + 0.5
    step = (high - low) / bins
    if not len(thresholds):
        return low + step * np.arange(bins + 1)
    low, high = min([low, *(t - 2 * step for t in thresholds)]), max([high, *(t + 2 * step for t in thresholds)])
    start = thresholds[0] - step * np.ceil((thresholds[0] - low) / step - 1e-9)
    return start + step * np.arange(int(np.ceil((high - start) / step - 1e-9)) + 1)


def draw_distribution(axes: Axes, distribution: Distribution) -> None:
    """A stacked histogram, the thresholds as lines."""
    values, is_kept = distribution.values, distribution.is_kept
    edges = bin_edges(values, distribution.thresholds)
    known = np.isfinite(values)
    clipped = np.clip(values, edges[0], np.nextafter(edges[-1], edges[0]))
    kept, rejected = (np.histogram(clipped[known & side], edges)[0] for side in (is_kept, ~is_kept))
    if known.any():
        axes.stairs(kept, edges, fill=True, color=TEAL, alpha=0.9)
        axes.stairs(kept + rejected, edges, baseline=kept, fill=True, color=AMBER, alpha=0.8)
    else:
        axes.text(0.5, 0.5, "unknown for all patches", transform=axes.transAxes, ha="center", va="center", color=INK)
    for threshold in distribution.thresholds:
        axes.axvline(threshold, color=PINK, linewidth=1.6)
    dress(axes, distribution.title)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))  # patches are counted
    if edges[1] - edges[0] == 1 and len(edges) <= LEVELS + 1:
        axes.set_xticks((edges[:-1] + edges[1:]) / 2)
    notes = [distribution.limit_text] if distribution.limit_text else []
    if known.any() and not known.all():
        notes.append(f"unknown: {int((~known).sum()):,}")
    axes.set_xlabel("; ".join(notes) or " ", color=PINK if distribution.limit_text else INK, fontsize=9)


def histograms(distributions: Sequence[Distribution], *, style: PlotFormat = "png") -> bytes:
    """All distributions in a grid, three in a row."""
    rows = -(-len(distributions) // _COLUMNS)
    figure = Figure(figsize=(9.6, 2.15 * rows + 0.35), layout="constrained")
    grid = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for axes, distribution in zip(grid, distributions, strict=False):
        draw_distribution(axes, distribution)
    for axes in grid[len(distributions) :]:
        axes.set_visible(False)
    _legend(figure)
    return figure_bytes(figure, style)


def _legend(figure: Figure) -> None:
    handles: list[Artist] = [Patch(color=colour) for colour in (TEAL, AMBER)]
    handles.append(Line2D([], [], color=PINK, linewidth=1.6))
    figure.legend(
        handles,
        ["kept", "rejected", "threshold"],
        loc="outside upper right",
        ncols=3,
        fontsize=9,
        frameon=False,
        labelcolor=INK,
    )


def viewpoint_rose(azimuth_deg: Values, is_kept: Flags, *, style: PlotFormat = "png") -> bytes:
    """How the cars are seen, from above with the front up: a petal's length is the number of cameras on that side."""
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, subplot_kw={"projection": "polar"})
    _draw_rose(left, azimuth_deg[is_kept], title="kept", colour=TEAL)
    _draw_rose(right, azimuth_deg[~is_kept], title="rejected", colour=AMBER)
    return figure_bytes(figure, style)


def rose_counts(azimuth_deg: Values) -> Int[np.ndarray, " petal"]:
    """Finite azimuths per petal; petal i is centred at i * 360 / `ROSE_BINS` degrees."""
    known = azimuth_deg[np.isfinite(azimuth_deg)]
    petals = np.round(known * (ROSE_BINS / 360)).astype(np.int64) % ROSE_BINS
    return np.bincount(petals, minlength=ROSE_BINS)


def _draw_rose(axes: Any, azimuth_deg: Values, *, title: str, colour: str) -> None:
    step = 2 * np.pi / ROSE_BINS
    axes.bar(step * np.arange(ROSE_BINS), rose_counts(azimuth_deg), width=step, color=colour, edgecolor="none")
    axes.set_theta_zero_location("N")
    axes.set_xticks(np.radians([0, 45, 90, 135, 180, 225, 270, 315]))
    axes.set_xticklabels(
        ["front 0°", "45°", "left side\n90°", "135°", "rear 180°", "-135°", "right side\n-90°", "-45°"]
    )
    axes.tick_params(colors=INK, labelsize=8, pad=6)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.set_rlabel_position(292.5)  # between front and right, where few cars are seen from
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_facecolor("none")
    axes.spines["polar"].set_color(GRID)
    axes.set_title(title, fontsize=10, fontweight="bold", color=INK)
