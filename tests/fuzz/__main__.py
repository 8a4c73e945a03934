"""`./run fuzz`: damaged labels, images, stores, checkpoints by the thousand; each must be read or refused in words."""

import argparse
import logging
import resource
import sys
import time
import warnings
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress
from rich.table import Table

from fuzz.campaign import Outcome, fuzz
from fuzz.targets import TARGETS

MEMORY_BYTES = 8 * 2**30  # of the whole process: an input that makes a reader ask for more is a fault


def main(arguments: list[str]) -> int:
    """Fuzz the targets in turn; exit code 1 when one did anything but read or refuse."""
    parser = argparse.ArgumentParser(prog="./run fuzz", description=__doc__)
    parser.add_argument("--target", choices=[*TARGETS, "all"], default="all")
    parser.add_argument("--inputs", type=int, default=1000, help="per target (1,000)")
    parser.add_argument("--seed", type=int, default=0, help="the same seed makes the same inputs (0)")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="folder of the inputs that crashed a reader")
    options = parser.parse_args(arguments)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore", UserWarning)  # Pillow's on damaged EXIF
    console, found = Console(), False
    table = Table("target", "inputs", "read", "refused", "faults", "seconds", "slowest (s)")
    for name in TARGETS if options.target == "all" else [options.target]:
        started = time.monotonic()
        with Progress(*Progress.get_default_columns(), MofNCompleteColumn(), console=console, transient=True) as bar:
            task = bar.add_task(name, total=options.inputs)
            outcome = fuzz(TARGETS[name], options.inputs, options.seed, partial(bar.advance, task))
        seconds = time.monotonic() - started
        row = (outcome.inputs, outcome.accepted, outcome.refused, len(outcome.crashes))
        table.add_row(name, *(f"{value:,}" for value in row), f"{seconds:.0f}", f"{outcome.slowest_s:.2f}")
        found |= bool(outcome.crashes)
        keep(outcome, options.out / name, console)
    console.print(table)
    return 1 if found else 0


def keep(outcome: Outcome, folder: Path, console: Console) -> None:
    """The input and the traceback of each fault."""
    for number, (kind, (data, trace)) in enumerate(outcome.crashes.items()):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{number}.input").write_bytes(data)
        (folder / f"{number}.txt").write_text(trace, encoding="utf-8")
        console.print(f"{folder / str(number)}: {kind}", markup=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
