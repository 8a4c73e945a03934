"""What a build did, in numbers."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class BuildSummary:
    """Counts of one `build` or `synth`; `problems` are inputs that were skipped, one sentence each."""

    out: Path
    source: str
    candidates: int
    kept: int
    instances: int  # with at least one kept patch
    reasons: dict[str, int] = field(default_factory=dict)  # "kept" and every first reason for rejection, with counts
    splits: dict[str, dict[str, int]] = field(default_factory=dict)  # name -> {"train": n, "test": n}
    problems: tuple[str, ...] = ()
    seconds: float = 0.0


def sort_reasons(counts: Mapping[str, int]) -> dict[str, int]:
    """Patches per reason, "kept" first, then the most frequent."""
    return dict(sorted(counts.items(), key=lambda item: (item[0] != "kept", -item[1], item[0])))
