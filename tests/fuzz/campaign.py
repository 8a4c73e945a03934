"""Feeding damaged files to a target and keeping those that it does not answer as it must."""

import random
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from carstudio.errors import InputError
from fuzz.mutations import mutate
from fuzz.targets import Target

SECONDS_PER_INPUT = 10  # a reader that takes longer hangs


@dataclass
class Outcome:
    """What a campaign saw. `crashes`: one input for each place in the code and kind of exception."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    crashes: dict[str, tuple[bytes, str]] = field(default_factory=dict)


class HungError(Exception):
    """An input took too long."""


def fuzz(target: Target, inputs: int, seed: int, step: Callable[[], None] = lambda: None) -> Outcome:
    """Run `inputs` damaged files through a target; the same seed gives the same files."""
    outcome = Outcome()
    with tempfile.TemporaryDirectory(prefix="carstudio-fuzz-") as name:
        seeds, folder = target.seeds(Path(name) / "seeds"), Path(name) / "case"
        folder.mkdir()
        for sound in seeds:
            target.read(sound, folder)
        for data in damaged(seeds, inputs, seed):
            _one(target, data, folder, outcome)
            step()
        shutil.rmtree(folder)
    return outcome


def damaged(seeds: list[bytes], inputs: int, seed: int) -> Iterator[bytes]:
    """Input i depends on (seed, i) alone, so that one of many can be made again."""
    for i in range(inputs):
        chance = random.Random(f"{seed}:{i}")
        yield mutate(seeds[i % len(seeds)], chance)


def _one(target: Target, data: bytes, folder: Path, outcome: Outcome) -> None:
    outcome.inputs += 1
    started = time.perf_counter()
    try:
        with time_limit(SECONDS_PER_INPUT):
            target.read(data, folder)
        outcome.accepted += 1
    except InputError:
        outcome.refused += 1
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit):
            raise
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "carstudio" in frame.filename]
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "outside"
        outcome.crashes.setdefault(f"{type(error).__name__} at {place}", (data, traceback.format_exc()))
    outcome.slowest_s = max(outcome.slowest_s, time.perf_counter() - started)


@contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """`HungError` after so long, where the system has alarms; nothing elsewhere."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(number: int, frame: object) -> None:
        raise HungError(f"more than {seconds} s")

    previous = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
