"""What a store was made from, in one digest: another label or photograph in the same place is another input.

Small texts count by their content, all else by name and size: reading half a million photographs would take minutes.
"""

import glob
import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from carstudio.files import sha256_file

_TEXTS = (".txt", ".csv", ".json")
_SMALL_BYTES = 4_000_000


def digest_of_inputs(places: Iterable[str | Path]) -> str:
    """sha256 over what lies at `places`: files, folders with everything below, patterns; a missing one counts too."""
    digest = hashlib.sha256()
    for place in places:
        for line in _lines(str(place)):
            digest.update(line.encode(errors="surrogateescape") + b"\n")
    return digest.hexdigest()


def _lines(place: str) -> Iterator[str]:
    path = Path(place)
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        yield from (f"{file.relative_to(path).as_posix()} {_mark(file)}" for file in files)
    elif path.is_file():
        yield f"{path.name} {_mark(path)}"
    elif glob.has_magic(place) and "://" not in place:
        yield from (f"{file} {_mark(Path(file))}" for file in sorted(glob.glob(place, recursive=True)))
    else:
        yield place


def _mark(file: Path) -> str:
    try:
        size = file.stat().st_size
        return sha256_file(file) if file.suffix.lower() in _TEXTS and size <= _SMALL_BYTES else str(size)
    except OSError as error:  # vanished, or not to be read: the build will say so
        return str(error.errno)
