"""What can be fuzzed: valid files to start from, and a reader that must give a sound value or an `InputError`."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from carstudio.errors import InputError
from fuzz.edits import Edit, Files, apply


def _as_is(files: Files) -> Files:
    return files


@dataclass(frozen=True)
class Target:
    """`read` gets the files and an empty folder of its own; it asserts what holds for every value it is given."""

    name: str
    seeds: Callable[[], Sequence[Files]]
    read: Callable[[Files, Path], None]
    mend: Callable[[Files], Files] = _as_is  # makes checksums and lengths right again, so that damage gets further in


def make_input(target: Target, seeds: Sequence[Files], edits: Sequence[Edit], seed: int, other: int) -> Files:
    """The input that edits make of seed number `seed`."""
    files = apply(edits, seeds[seed % len(seeds)], seeds[other % len(seeds)])
    return target.mend(files) if any(edit.kind == "mend" for edit in edits) else files


def is_refused(target: Target, files: Files, folder: Path) -> bool:
    """Read an input: True for an `InputError` with a message, False for a sound value; all else is a find."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)  # numpy's, on numbers that run over
        try:
            target.read(files, folder)
        except InputError as error:
            message = str(error)
        else:
            return False
    assert message.strip(), "an InputError without a message"
    return True


def write_files(files: Files, folder: Path) -> None:
    """The files of an input in a folder; their names may hold slashes."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
