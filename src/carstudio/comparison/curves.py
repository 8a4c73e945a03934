"""What `ttopt` has measured: the curve of one row fitted in one way, and the tables of several."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from carstudio.comparison.rows import Row
from carstudio.comparison.table import TITLES
from carstudio.evaluation.summary import Estimate, estimate
from carstudio.evaluation.tables import Cell, Table

LATENTS, FIELD, FIELD_ALONE, NO_PRIOR = "latents", "latents and field", "field", "no prior"
TURNS_DEG = (0, 15, 45, 90, 181)


@dataclass(frozen=True)
class Curve:
    """One row fitted in one way: its scores at every mark, and where its pictures are."""

    row: Row
    mode: str
    scores: list[dict[str, Any]]
    pictures: Path
    cpu_seconds: float = 0.0

    @property
    def title(self) -> str:
        """How tables call it."""
        return f"{self.row.title}: {self.mode}"

    @property
    def marks(self) -> list[int]:
        """Steps after which it was scored."""
        return sorted({score["fit_steps"] for score in self.scores})


def curve_table(found: Sequence[Curve], views: str, last: int) -> Table:
    """Before and after: what the encoder gives, what is there after the last step, and where it was best."""
    rows = []
    for curve in found:
        scores = [score for score in curve.scores if score["views"] == views]
        marks = sorted({score["fit_steps"] for score in scores})
        values = {mark: estimate_of(scores, mark, "psnr") for mark in marks}
        best = max(marks, key=lambda mark: values[mark].mean)
        rows.append(
            (
                Cell(curve.title),
                Cell(str(values[marks[0]].count)),
                Cell(str(len({score["instance_id"] for score in scores}))),
                _cell(values[marks[0]], 2),
                _cell(values[marks[-1]], 2),
                Cell(f"{values[best].mean:.2f} at {best}"),
                _cell(estimate_of(scores, marks[0], "ssim"), 4),
                _cell(estimate_of(scores, marks[-1], "ssim"), 4),
                _cell(estimate_of(scores, marks[0], "psnr_mask"), 2),
                _cell(estimate_of(scores, marks[-1], "psnr_mask"), 2),
            )
        )
    heads = ("PSNR before", f"PSNR after {last}", "best at step", "SSIM before", "SSIM after")
    what = "views that no step saw" if views == "held-out" else "the very views that were fitted"
    return Table(
        caption=f"{TITLES['ttopt']}: {what}",
        columns=("Method", "Images", "Cars", *heads, "PSNR (car) before", "PSNR (car) after"),
        rows=tuple(rows),
        notes=(
            "In brackets the 95 % interval of the mean, by resampling cars.",
            "PSNR in dB on the box crop, truth on black.",
        ),
    )


def turn_table(found: Sequence[Curve]) -> Table:
    """PSNR after the last step by how far around the car a held-out view was taken from the nearest fitted one."""
    ranges = list(pairwise(TURNS_DEG))
    rows = []
    for curve in found:
        last = max(score["fit_steps"] for score in curve.scores)
        cells = []
        for low, high in ranges:
            chosen = [s for s in curve.scores if s["views"] == "held-out" and low <= s["turned_deg"] < high]
            cells.append(_cell(estimate_of(chosen, last, "psnr"), 2) if chosen else Cell("–"))
        rows.append((Cell(curve.title), *cells))
    heads = [f"{low} to {min(high, 180)} deg" for low, high in ranges]
    caption = "PSNR (dB) after fitting, by the angle to the nearest fitted view"
    return Table(caption=caption, columns=("Method", *heads), rows=tuple(rows))


def estimate_of(scores: Sequence[dict[str, Any]], mark: int, metric: str) -> Estimate:
    """Mean of a metric after some steps, with its interval by resampling cars; NaN where nothing was measured."""
    chosen = [(s[metric], s["instance_id"]) for s in scores if s["fit_steps"] == mark and s[metric] is not None]
    if not chosen:
        return Estimate(float("nan"), None, None, 0)
    return estimate([value for value, _ in chosen], [who for _, who in chosen])


def _cell(found: Estimate, digits: int) -> Cell:
    if found.count == 0:
        return Cell("–")
    detail = "" if found.low is None or found.high is None else f"[{found.low:.{digits}f}, {found.high:.{digits}f}]"
    return Cell(f"{found.mean:.{digits}f}", detail=detail)
