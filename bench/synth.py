"""Speed of `carstudio synth`: cars and views per second. Usage: python bench/synth.py [--cars N] [--workers N] ..."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import tyro

from carstudio.dataset.sources.synthetic import SynthConfig, synthesize


@dataclass(frozen=True)
class Bench:
    """What to time."""

    cars: int = 40
    views: int = 12
    size: int = 128
    workers: int = 0


def main(bench: Bench) -> None:
    """Make a store in a temporary folder and print the figures."""
    with tempfile.TemporaryDirectory() as folder:
        summary = synthesize(SynthConfig(out=Path(folder) / "store", **vars(bench)))
    print(
        f"{bench.cars} cars x {bench.views} views at {bench.size} px: {summary.seconds:.1f} s, "
        f"{bench.cars / summary.seconds:.2f} cars/s, {summary.candidates / summary.seconds:.1f} views/s"
    )


if __name__ == "__main__":
    main(tyro.cli(Bench))
