"""How the learning rate falls: a linear warm-up, then from first to last, exponentially or along a line."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class ScheduleConfig:
    """Learning rates over a run; the defaults are the paper's."""

    first: float = 1e-3
    """Learning rate after the warm-up."""
    last: float = 1e-4
    """Learning rate at the end of the decay, kept from there on."""
    decay: Literal["exponential", "linear"] = "exponential"
    """"exponential": by the same factor each step; "linear": by the same difference."""
    decay_steps: int | None = 200_000
    """Steps of the decay; None: the whole run, by steps or by time, whichever is further on."""
    warmup_steps: int = 0
    """Steps of linear growth from 0 (RAdam has a warm-up of its own; small recipes add one)."""


def learning_rate(config: ScheduleConfig, step: int, run_fraction: float) -> float:
    """Rate for 0-based `step`; `run_fraction` in [0, 1] is how much of the run's budget is spent."""
    fraction = run_fraction if config.decay_steps is None else step / config.decay_steps
    fraction = min(max(fraction, 0.0), 1.0)
    if config.decay == "linear":
        rate = config.first + fraction * (config.last - config.first)
    else:
        rate = config.first * (config.last / config.first) ** fraction
    return rate * min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else rate
