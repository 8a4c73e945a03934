"""The paper's qualitative figure: a row per unseen car, a column per model, colour above and opacity in Turbo below."""

from collections.abc import Sequence

import numpy as np

from carstudio.comparison.rows import Row
from carstudio.comparison.running import PROTOCOLS, Work, open_model
from carstudio.evaluation.protocols import ScoredView, can_score, score_views, view_pairs
from carstudio.images import to_uint8
from carstudio.report.colours import turbo
from carstudio.report.panels import truth_on_black
from carstudio.report.sheets import Pixels, side_by_side

CARS = 4
TILE_PX = (128, 96)


def qualitative_grid(work: Work, rows: Sequence[Row], cars: int = CARS) -> Pixels | None:
    """Input, each model's colour and opacity, truth: other views of a few cars; None where there is nothing to show."""
    config = next((found for p in PROTOCOLS if can_score(work.store, found := work.evaluation(p, rows[0]))), None)
    if config is None:
        return None
    first = {pair.instance_id: pair for pair in reversed(view_pairs(work.store, config))}
    pairs = list(first.values())[::-1]
    pairs = [pairs[i * len(pairs) // min(cars, len(pairs))] for i in range(min(cars, len(pairs)))]
    columns = [list(score_views(open_model(work, row), work.store, pairs)) for row in rows]
    pictures: list[list[Pixels]] = []
    for views in zip(*columns, strict=True):
        pictures += _two_rows(views)
    return side_by_side(pictures, heads=["input", *(row.name for row in rows), "truth"], tile_px=TILE_PX)


def _two_rows(views: Sequence[ScoredView]) -> list[list[Pixels]]:
    shown, scored = views[0].input_patch, views[0].scored_patch
    mask = turbo((scored.mask.numpy() == 255).astype(np.float32))
    colours = [to_uint8(view.rgb.numpy()) for view in views]
    opacities = [turbo(view.opacity.numpy()) for view in views]
    blank = np.full_like(shown.rgb.numpy(), 222)
    return [[shown.rgb.numpy(), *colours, truth_on_black(scored)], [blank, *opacities, mask]]
