"""Means of result rows with their uncertainty.

Images of one car resemble each other, so the interval comes from drawing whole cars again, not images (cluster
bootstrap; Field and Welsh 2007).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from carstudio.evaluation.results import METRICS, ResultRow

BOOTSTRAP_DRAWS = 2000  # the ends of a 95 % interval then rest on 50 draws each
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Estimate:
    """Mean over `count` images; `low` and `high` bound its 95 % interval, None when there is only one instance."""

    mean: float
    low: float | None
    high: float | None
    count: int


@dataclass(frozen=True, kw_only=True)
class Summary:
    """One method in one protocol on one split. `metrics` lacks what no image has."""

    method: str
    protocol: str
    split: str
    num_images: int
    num_instances: int
    metrics: Mapping[str, Estimate]


def summarise(rows: Sequence[ResultRow], *, seed: int = 0, draws: int = BOOTSTRAP_DRAWS) -> list[Summary]:
    """One `Summary` per (method, protocol, split), in the order of first appearance; row order changes no figure."""
    groups: dict[tuple[str, str, str], list[ResultRow]] = {}
    for row in rows:
        groups.setdefault((row.method, row.protocol, row.split), []).append(row)
    return [_summary(key, group, seed, draws) for key, group in groups.items()]


def _summary(key: tuple[str, str, str], rows: Sequence[ResultRow], seed: int, draws: int) -> Summary:
    metrics = {}
    for name in METRICS:
        scored = [(row.instance_id, getattr(row, name)) for row in rows if getattr(row, name) is not None]
        if scored:
            metrics[name] = estimate([value for _, value in scored], [who for who, _ in scored], seed=seed, draws=draws)
    return Summary(
        method=key[0],
        protocol=key[1],
        split=key[2],
        num_images=len(rows),
        num_instances=len({row.instance_id for row in rows}),
        metrics=metrics,
    )


def estimate(
    values: Sequence[float], instances: Sequence[str], *, seed: int = 0, draws: int = BOOTSTRAP_DRAWS
) -> Estimate:
    """Mean of `values` with a percentile interval from resampling instances with replacement (seeded)."""
    names, which = np.unique(np.asarray(instances), return_inverse=True)
    order = np.lexsort((np.asarray(values), which))  # sums in a fixed order: row order changes not even a last digit
    ordered, which = np.asarray(values, np.float64)[order], which[order]
    sums, counts = np.bincount(which, weights=ordered), np.bincount(which)
    mean = float(sums.sum() / counts.sum())
    if len(names) < 2:
        return Estimate(mean, None, None, len(values))
    times = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), size=draws)
    means = (times @ sums) / (times @ counts)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return Estimate(mean, float(low), float(high), len(values))
