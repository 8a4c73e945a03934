"""`./run faults`: kill train, build and synth at random moments, start them again, compare what they leave."""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from faults.forks import Forks
from faults.kills import Case, Reference, make_reference, run_case
from faults.targets import TARGETS, make_inputs


def main(arguments: list[str]) -> int:
    """Kill as often as asked; exit code 1 when something came out different."""
    options = parse(arguments)
    work = Path(options.keep or tempfile.mkdtemp(prefix="carstudio-faults-"))
    work.mkdir(parents=True, exist_ok=True)
    console, started = Console(), time.monotonic()
    names = list(TARGETS) if options.target == "all" else [options.target]
    with Progress(console=console) as progress:
        task = progress.add_task("references", total=options.kills)
        cases = []
        for case in kill(names, options.kills, seed=options.seed, jobs=options.jobs, work=work):
            cases.append(case)
            progress.update(task, description=f"kills, last: {case.target}", advance=len(case.kills))
            if options.minutes is not None and time.monotonic() - started > 60 * options.minutes:
                break
    seconds = time.monotonic() - started
    console.print(summary(cases))
    failed = [case for case in cases if case.differences]
    for case in failed:
        console.print(f"seed {case.seed}: {'; '.join(case.differences)}  (kept in {work / 'cases' / case.seed})")
    num_kills = sum(len(case.kills) for case in cases)
    console.print(f"{num_kills} kills in {len(cases)} cases, {seconds:.0f} s, {len(failed)} cases differ")
    return 1 if failed else 0


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="./run faults", description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="SIGKILLs in all (50)")
    parser.add_argument("--target", choices=[*TARGETS, "all"], default="all")
    parser.add_argument("--seed", type=int, default=0, help="chooses every kill's moment (0)")
    parser.add_argument("--minutes", type=float, help="end after this time, with fewer kills")
    parser.add_argument("--jobs", type=int, default=2, help="runs at the same time (2)")
    parser.add_argument("--keep", help="folder for the runs; those that came out well are removed")
    options = parser.parse_args(arguments)
    if options.kills < 1 or options.jobs < 1:
        parser.error("--kills and --jobs must be at least 1")
    return options


def kill(names: list[str], kills: int, *, seed: int, jobs: int, work: Path) -> Iterator[Case]:
    """Cases of the targets in turn until so many kills have landed, `jobs` at a time."""
    inputs = work / "inputs"
    if not inputs.exists():
        make_inputs(inputs)
    with ExitStack() as stack:
        idle: SimpleQueue[Forks] = SimpleQueue()
        servers = [stack.enter_context(Forks()) for _ in range(jobs)]
        references = [_references(servers[0], name, inputs, work / "references") for name in names]
        for server in servers:
            idle.put(server)
        pool = stack.enter_context(ThreadPoolExecutor(jobs))

        def one(number: int) -> Case:
            variants = references[number % len(references)]
            reference = variants[number // len(references) % len(variants)]
            server = idle.get()
            try:
                name = f"{seed}-{number:05d}"
                return run_case(server, reference, inputs, work / "cases" / name, name)
            finally:
                idle.put(server)

        landed, number, running = 0, 0, set[Future[Case]]()
        while landed < kills or running:
            while landed < kills and len(running) < jobs:
                running.add(pool.submit(one, number))
                number += 1
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                landed += len(future.result().kills)
                yield future.result()


def _references(server: Forks, name: str, inputs: Path, folder: Path) -> list[Reference]:
    """One per variant; equal variants share one."""
    made: dict[str, Reference] = {}
    for variant in TARGETS[name]:
        key = " ".join(variant.arguments(Path("in"), Path("out")))
        if key not in made:
            made[key] = make_reference(server, variant, inputs, folder / f"{name}-{len(made)}")
    return [made[" ".join(variant.arguments(Path("in"), Path("out")))] for variant in TARGETS[name]]


def summary(cases: list[Case]) -> Table:
    """Kills per target and place."""
    table = Table("target", "where the kill landed", "kills", "orphans at most", "cases that differ")
    for target in sorted({case.target for case in cases}):
        mine = [case for case in cases if case.target == target]
        places = Counter(kill.landed for case in mine for kill in case.kills)
        for place, count in places.most_common():
            lived = max(kill.orphans_s for case in mine for kill in case.kills if kill.landed == place)
            differ = sum(1 for case in mine if case.differences and any(kill.landed == place for kill in case.kills))
            table.add_row(target, place, str(count), f"{lived:.2f} s", str(differ))
        num_kills, num_differ = sum(places.values()), sum(1 for case in mine if case.differences)
        table.add_row(target, f"all ({len(mine)} cases)", str(num_kills), "", str(num_differ), end_section=True)
    return table


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
