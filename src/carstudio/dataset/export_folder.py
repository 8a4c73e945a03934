"""The folder that an export fills: new or empty, or left by an export that was interrupted."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from carstudio.errors import InputError, StorageError
from carstudio.files import inside, remove_partials, write_text

UNFINISHED = ".unfinished-export"  # lies in the folder until the export is whole
Which = Literal["kept", "all"]  # patches: rejected ones too?


@dataclass(frozen=True)
class ExportSummary:
    """What an export wrote, and how many patches it left out for which reason."""

    out: Path
    files: dict[str, int]  # index file -> records
    left_out: dict[str, int]


@contextmanager
def export_folder(out: Path) -> Iterator[None]:
    """Makes `out` in the beginning and marks it until the block has ended well; `InputError` when others use it."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: expected a folder to export to, found a file; choose another --out")
    if out.is_dir() and any(out.iterdir()) and not (out / UNFINISHED).exists():
        raise InputError(f"{out}: holds other files; choose a new or an empty folder for --out")
    if out.is_dir():
        remove_partials(out)
    write_text(out / UNFINISHED, "carstudio dataset export was interrupted here; the same command finishes it\n")
    yield
    (out / UNFINISHED).unlink()


def write_once(out: Path, name: str, data: bytes) -> None:
    """Write a file that nobody else wants to be another; one that an interrupted export left is taken as it is."""
    path = inside(out, name)
    try:
        if path.exists() and path.read_bytes() != data:
            raise InputError(
                f"{path}: two patches want this file with other content, or it is broken; remove the folder"
            )
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_name(f".{path.name}.partial")  # no fsync: a million of them would take an hour
            partial.write_bytes(data)
            partial.replace(path)
    except OSError as error:
        raise StorageError(path, error.strerror) from error
