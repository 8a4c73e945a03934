"""One case: a run killed, started again until it ends, and compared with the uninterrupted one."""

import random
import shutil
from dataclasses import dataclass
from pathlib import Path

from faults.forks import Forks
from faults.server import Ended, Request
from faults.targets import Target

MOST_KILLS = 4  # of one case
LATEST = 1.05  # of the uninterrupted run's duration: beyond its end now and then
NO_OPERATION = 10**9  # counts without killing


@dataclass(frozen=True)
class Reference:
    """The uninterrupted run of a target."""

    target: Target
    arguments: list[str]
    snapshot: dict[str, str]
    seconds: float
    operations: int


@dataclass(frozen=True)
class Kill:
    """One kill: where it landed, how long the workers outlived it."""

    how: str
    landed: str
    orphans_s: float


@dataclass(frozen=True)
class Case:
    """What became of a case; `differences` is empty when it ended in the same bytes."""

    seed: str
    target: str
    kills: tuple[Kill, ...]
    differences: tuple[str, ...]


def make_reference(forks: Forks, target: Target, inputs: Path, folder: Path) -> Reference:
    """Run the target undisturbed."""
    out = folder / "out"
    arguments = target.arguments(inputs, out)
    ended = _run(forks, arguments, folder, at_operation=NO_OPERATION)
    if ended.code != 0:
        raise RuntimeError(f"{target.name} fails by itself; see {folder / 'log'}")
    return Reference(target, arguments, target.snapshot(out), ended.seconds, ended.operations)


def run_case(forks: Forks, reference: Reference, inputs: Path, folder: Path, seed: str) -> Case:
    """Kill at random moments, drawn from `seed` alone, then let it end; `folder` is removed when all is well."""
    rng = random.Random(seed)
    target, out = reference.target, folder / "out"
    first = target.arguments(inputs, out)
    kills: list[Kill] = []
    folder.mkdir(parents=True)
    while len(kills) < MOST_KILLS and (not kills or rng.random() < 0.5):
        how, options = _draw_kill(rng, reference)
        ended = _run(forks, target.restart(first, out), folder, **options)
        if ended.code == 0:
            break  # done before the kill came
        kills.append(Kill(how, target.landed(out), ended.orphans_s))
    ended = _run(forks, target.restart(first, out), folder)
    differences = compare(reference.snapshot, target.snapshot(out))
    if ended.code != 0:
        differences = (f"the last run ended with {ended.code}", *differences)
    if not differences:
        shutil.rmtree(folder)
    else:
        (folder / "case.txt").write_text("\n".join([f"seed {seed}", *map(str, kills), *differences]) + "\n")
    return Case(seed, target.name, tuple(kills), differences)


def _draw_kill(rng: random.Random, reference: Reference) -> tuple[str, dict[str, float | int | bool]]:
    to_group = rng.random() < 0.5
    whom = "all processes" if to_group else "the parent"
    if rng.random() < 0.5:
        return f"by time, {whom}", {"after_s": rng.uniform(0, LATEST * reference.seconds), "to_group": to_group}
    number = rng.randint(1, reference.operations)
    return f"at a file operation, {whom}", {"at_operation": number, "to_group": to_group}


def _run(forks: Forks, arguments: list[str], folder: Path, **options: float | int | bool) -> Ended:
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log"
    return forks.run(Request(arguments=arguments, log=str(log), **options))  # type: ignore[arg-type]  # one per field


def compare(expected: dict[str, str], found: dict[str, str]) -> tuple[str, ...]:
    """One sentence per file that differs."""
    names = sorted(expected.keys() | found.keys())
    differ = [name for name in names if expected.get(name) != found.get(name)]
    return tuple(
        f"{name}: {'missing' if name not in found else 'too much' if name not in expected else 'differs'}"
        for name in differ
    )
