"""Files that are either whole or absent: atomic writes and checksums."""

import hashlib
import json
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from carstudio.errors import InputError, StorageError

_HALF_PAIR = re.compile(r"\\u[dD][89a-fA-F]")
_PARTIAL = re.compile(r"\..*-[a-z0-9_]{8}\.partial(\.[^.]+)?")  # the temporary names of `atomic_path`


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """A temporary name beside `path` that takes its place when the block ends well and vanishes when it does not.

    The data reach the disk before the name does (fsync), so that a kill or a power cut leaves the old file or the new.
    `StorageError` names `path` when the system refuses to write (disk full, folder read-only).
    """
    path = Path(path)
    partial: Path | None = None
    try:
        partial = _new_partial(path)
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.chmod(0o666 & ~_umask())
        partial.replace(path)
    except OSError as error:
        if isinstance(error.filename, str) and Path(error.filename).parent not in path.parents:
            raise  # about another file, which the block was reading
        raise StorageError(path, os.strerror(error.errno) if error.errno else error) from error
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)


def require_writable(path: Path | str) -> None:
    """`StorageError` now rather than after an hour's work when a file could not be made at `path`."""
    try:
        _new_partial(Path(path)).unlink()
    except OSError as error:
        raise StorageError(path, error.strerror) from error


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, unless it is there; `InputError` when a file has its name."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise InputError(f"{folder}: expected a folder, found a file; choose another place") from error


def _new_partial(path: Path) -> Path:
    """An empty file with a temporary name beside `path`, whose folder is made when it is missing."""
    make_folder(path.parent)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=f".partial{path.suffix}", dir=path.parent)
    os.close(handle)
    return Path(name)


def remove_partials(folder: Path | str) -> None:
    """Delete what a killed process left of unfinished files in `folder` and below; its lock must be held."""
    for path in Path(folder).rglob(".*.partial*"):
        if is_partial(path) and path.is_file():
            path.unlink(missing_ok=True)


def is_partial(path: Path) -> bool:
    """Whether a name is a temporary one of `atomic_path`."""
    return _PARTIAL.fullmatch(path.name) is not None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write `data` atomically."""
    with atomic_path(path) as partial:
        partial.write_bytes(data)


def write_text(path: Path | str, text: str) -> None:
    """Write `text` atomically as UTF-8."""
    write_bytes(path, text.encode())


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` atomically as indented JSON with sorted keys, so that equal values give equal bytes."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n")


def read_json(path: Path | str) -> Any:
    """Read a JSON file; `InputError` names the file and the place when it is missing or not JSON."""
    path = Path(path)
    try:
        return parse_json(path.read_bytes(), name=str(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a JSON file") from error


def parse_json(text: str | bytes, *, name: str) -> Any:
    """A JSON value; `InputError` for anything else, nesting and numbers that no file of ours has included.

    Its texts can be written as UTF-8: an escaped half of a surrogate pair without the other is refused too.
    """
    try:
        value = json.loads(text)
        if _HALF_PAIR.search(text if isinstance(text, str) else text.decode()):
            json.dumps(value, ensure_ascii=False).encode()
        return value
    except ValueError as error:  # JSONDecodeError, UnicodeDecodeError, and Python's limit on the digits of a number
        shown = text[:60] if isinstance(text, str) else text[:60].decode("utf-8", errors="replace")
        raise InputError(f"{name}: expected JSON, found {shown!r} ({error})") from error
    except RecursionError as error:
        raise InputError(f"{name}: expected JSON, found one value in another, hundreds deep") from error


def read_bounded(path: Path | str, what: str, *, max_bytes: int) -> bytes:
    """A whole file; `InputError` when it cannot be read or is larger than anything of its kind."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            data = file.read(max_bytes + 1) if size <= max_bytes else b""
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = (error.strerror or error) if isinstance(error, OSError) else error
        raise InputError(f"{path}: {what} cannot be read ({reason}); replace or remove it") from error
    if max(size, len(data)) > max_bytes:
        found = max(size, len(data))
        raise InputError(f"{path}: {what} must be of at most {max_bytes:,} bytes, found {found:,}; check the file")
    return data


def sha256_file(path: Path | str) -> str:
    """Hexadecimal sha256 of a file's bytes."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def inside(folder: Path | str, name: str) -> Path:
    """`folder / name`, refused when a name taken from a data file climbs out of the folder."""
    folder = Path(folder).resolve()
    path = (folder / name).resolve() if "\0" not in name else None
    if path is None or not path.is_relative_to(folder):
        raise InputError(f"path {name!r} leaves its folder {folder}; expected a path below it")
    return path
