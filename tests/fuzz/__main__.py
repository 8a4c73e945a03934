"""`./run fuzz`: damaged inputs through every reader; each must end in a sound value or in an `InputError`.

Exit code 1 when one did not; what it was is kept, made small, in a folder.
"""

import argparse
import os
import re
import sys
import tempfile
from pathlib import Path

import torch
from jaxtyping import install_import_hook
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

with install_import_hook("carstudio", "beartype.beartype"):  # a value of another type or shape than promised is a find
    from fuzz.campaign import Tally, attempt, run_campaign
    from fuzz.minimise import minimise, save_find
    from fuzz.targets import TARGETS


def main(arguments: list[str]) -> int:
    """Fuzz or replay."""
    options = parse(arguments)
    if options.engine == "atheris":
        run_guided(options.target, inputs=options.inputs, seed=options.seed, out=options.out)
    torch.set_num_threads(1)
    if options.replay:
        return replay(options.target, options.replay)
    console, tallies = Console(), []
    out = Path(options.out or tempfile.mkdtemp(prefix="carstudio-fuzz-finds-"))
    names = list(TARGETS) if options.target == "all" else [options.target]
    for name in names:
        with Progress(console=console, transient=True) as progress:
            task = progress.add_task(name, total=options.inputs)
            tally = run_campaign(
                TARGETS[name],
                inputs=options.inputs,
                seed=options.seed,
                jobs=options.jobs,
                report=lambda done, task=task, progress=progress: progress.update(task, completed=done),
            )
        console.print(describe(tally))
        keep(tally, out, options.seed, console)
        tallies.append(tally)
    console.print(summary(tallies))
    return 1 if any(tally.finds for tally in tallies) else 0


def parse(arguments: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(prog="./run fuzz", description=__doc__)
    parser.add_argument("--target", choices=[*TARGETS, "all"], default="all")
    parser.add_argument("--engine", choices=["edits", "atheris"], default="edits", help="atheris: led by coverage")
    parser.add_argument("--inputs", type=int, default=1000, help="per target (1000)")
    parser.add_argument("--seed", type=int, default=0, help="chooses every input (0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (2)")
    parser.add_argument("--out", help="folder for what was found (a temporary one)")
    parser.add_argument("--replay", help="folder of one find: read its files again and show what happens")
    options = parser.parse_args(arguments)
    if options.inputs < 1 or options.jobs < 1:
        parser.error("--inputs and --jobs must be at least 1")
    if (options.replay or options.engine == "atheris") and options.target == "all":
        parser.error("--replay and --engine atheris need --target")
    return options


def run_guided(name: str, *, inputs: int, seed: int, out: str | None) -> None:
    """Become the other program: it must mark the branches of the readers while it imports them."""
    folder = out or tempfile.mkdtemp(prefix="carstudio-fuzz-finds-")
    options = ["--target", name, "--inputs", str(inputs), "--seed", str(seed), "--out", folder]
    os.execv(sys.executable, [sys.executable, "-m", "fuzz.guided", *options])


def describe(tally: Tally) -> str:
    """One line."""
    return (
        f"{tally.target}: {tally.inputs} inputs, {tally.refused} refused, {tally.seconds:.0f} s, "
        f"slowest {tally.slowest_s:.1f} s, {len(tally.finds)} kinds of finds"
    )


def keep(tally: Tally, out: Path, seed: int, console: Console) -> None:
    """Save one small reproducer for each kind of find."""
    for signature, finds in tally.finds.items():
        folder = out / tally.target / re.sub(r"[^A-Za-z0-9]+", "-", signature)
        with tempfile.TemporaryDirectory() as work:
            files = minimise(TARGETS[tally.target], finds[0], seed=seed, folder=Path(work) / "files")
        command = f"./run fuzz --target {tally.target} --replay {folder}"
        save_find(files, finds[0], folder, command=command)
        console.print(f"  {len(finds)} x {signature}: {command}")


def replay(name: str, folder: str) -> int:
    """Read the files of a find again."""
    paths = [path for path in Path(folder).rglob("*") if path.is_file() and path.name != "find.json"]
    files = {str(path.relative_to(folder)): path.read_bytes() for path in paths}
    with tempfile.TemporaryDirectory() as work:
        is_no, signature, trace = attempt(TARGETS[name], files, Path(work) / "files")
    print(trace or ("refused" if is_no else "read"))
    return 1 if signature else 0


def summary(tallies: list[Tally]) -> Table:
    """Figures per target."""
    table = Table("target", "inputs", "refused", "time", "slowest", "kinds of finds")
    for tally in tallies:
        cells = [f"{tally.inputs:,}", f"{tally.refused:,}", f"{tally.seconds:.0f} s", f"{tally.slowest_s:.2f} s"]
        table.add_row(tally.target, *cells, str(len(tally.finds)))
    return table


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
