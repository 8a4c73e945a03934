"""Which photographs: a folder, a glob, or a list (txt, csv, parquet), of local files or of any fsspec URL."""

import csv
import glob
import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from carstudio.errors import InputError, first_line
from carstudio.images import MAX_IMAGE_BYTES, read_image_file

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
LIST_SUFFIXES = (".txt", ".csv", ".parquet")
MAX_LIST_BYTES = 2**30
ID_LENGTH = 80  # of a frame id: a patch id has a prefix and a number besides
_SAFE = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]*[A-Za-z0-9_-])?")
_ODD = re.compile(r"[^A-Za-z0-9._]+")
_COLUMNS = ("path", "instance_id", "licence", "camera")


@dataclass(frozen=True)
class PhotoFile:
    """One photograph of a list. `path` names it in the store, relative to the root, with forward slashes."""

    location: str  # local path or URL
    path: str
    frame_id: str
    instance_id: str | None = None  # what car it shows, where the list tells
    licence: str | None = None
    camera: str | None = None  # a camera spec for this photograph alone


def is_url(text: str) -> bool:
    """Whether fsspec opens it rather than the file system."""
    return "://" in text


def find_photos(root: str) -> tuple[PhotoFile, ...]:
    """All photographs that `root` names, in order of their paths (a list: in its order)."""
    if is_url(root):
        rows = _rows_of_url(root)
    elif Path(root).is_dir():
        folder = Path(root)
        found = (file for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
        rows = [{"path": str(file), "name": file.relative_to(folder).as_posix()} for file in sorted(found)]
    elif glob.has_magic(root):
        rows = _named_below_common_folder(sorted(glob.glob(root, recursive=True)))
    elif Path(root).suffix.lower() in LIST_SUFFIXES:
        rows = _rows_of_list(root, str(Path(root).parent))
    elif Path(root).is_file():
        rows = [{"path": root, "name": Path(root).name}]
    else:
        raise InputError(f"{root}: no such folder, photograph, list ({', '.join(LIST_SUFFIXES)}) or pattern")
    if not rows:
        raise InputError(f"{root}: no photographs; expected files ending in {', '.join(SUFFIXES)}")
    return _with_ids(rows)


def read_photo(location: str) -> bytes:
    """The encoded photograph; `InputError` when it cannot be read or is larger than any photograph."""
    return read_image_file(location) if not is_url(location) else _read_url(location, MAX_IMAGE_BYTES)


def _read_url(url: str, max_bytes: int) -> bytes:
    import fsspec

    try:
        with fsspec.open(url, "rb") as file:
            data: bytes = file.read(max_bytes + 1)
    except Exception as error:  # every protocol has its own
        raise InputError(f"{url}: cannot be read ({type(error).__name__}: {first_line(error)})") from error
    if len(data) > max_bytes:
        raise InputError(f"{url}: at most {max_bytes:,} bytes are read, found more; check the file")
    return data


def _rows_of_url(root: str) -> list[dict[str, Any]]:
    if PurePosixPath(root).suffix.lower() in LIST_SUFFIXES:
        return _rows_of_list(root, root.rpartition("/")[0])
    import fsspec

    try:
        system, folder = fsspec.core.url_to_fs(root)
        if PurePosixPath(root).suffix.lower() in SUFFIXES and not glob.has_magic(root):
            return [{"path": root, "name": PurePosixPath(root).name}]
        files = sorted(system.glob(folder) if glob.has_magic(root) else system.find(folder))
    except Exception as error:  # every protocol has its own
        raise InputError(f"{root}: cannot be listed ({type(error).__name__}: {error})") from error
    wanted = [file for file in files if PurePosixPath(file).suffix.lower() in SUFFIXES]
    base = PurePosixPath(folder) if not glob.has_magic(root) else _common_folder(wanted)
    return [
        {"path": system.unstrip_protocol(file), "name": PurePosixPath(file).relative_to(base).as_posix()}
        for file in wanted
    ]


def _common_folder(files: Sequence[str]) -> PurePosixPath:
    parts = [PurePosixPath(file).parent.parts for file in files]
    common: list[str] = []
    for level in zip(*parts, strict=False):
        if len(set(level)) > 1:
            break
        common.append(level[0])
    return PurePosixPath(*common)


def _named_below_common_folder(files: Iterable[str]) -> list[dict[str, Any]]:
    wanted = [Path(file).as_posix() for file in files if Path(file).suffix.lower() in SUFFIXES and Path(file).is_file()]
    base = _common_folder(wanted)
    return [{"path": file, "name": PurePosixPath(file).relative_to(base).as_posix()} for file in wanted]


def _rows_of_list(location: str, base: str) -> list[dict[str, Any]]:
    """Rows of a list; relative paths count from its folder."""
    if is_url(location):
        data = _read_url(location, MAX_LIST_BYTES)
    else:
        try:
            data = Path(location).read_bytes()
        except OSError as error:
            raise InputError(f"{location}: list cannot be read ({error.strerror})") from error
    suffix = PurePosixPath(location).suffix.lower()
    if suffix == ".parquet":
        rows = _parquet_rows(data, location)
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{location}: expected a list as UTF-8 text, found binary data") from error
        rows = _csv_rows(text, location) if suffix == ".csv" else _text_rows(text)
    return [_row(row, number, location, base) for number, row in rows]


def _text_rows(text: str) -> list[tuple[str, Mapping[str, Any]]]:
    lines = ((f"line {number}", line.strip()) for number, line in enumerate(text.split("\n"), start=1))
    return [(number, {"path": line}) for number, line in lines if line and not line.startswith("#")]


def _csv_rows(text: str, location: str) -> list[tuple[str, Mapping[str, Any]]]:
    try:
        rows = list(csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{location}: expected CSV with a header ({error})") from error
    return [(f"row {number}", row) for number, row in enumerate(rows, start=1)]


def _parquet_rows(data: bytes, location: str) -> list[tuple[str, Mapping[str, Any]]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(data))
        rows = table.select([name for name in table.column_names if name in _COLUMNS]).to_pylist()
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        raise InputError(f"{location}: expected a Parquet list ({first_line(error)})") from error
    return [(f"row {number}", row) for number, row in enumerate(rows, start=1)]


def _row(row: Mapping[str, Any], number: str, location: str, base: str) -> dict[str, Any]:
    path = row.get("path")
    if not isinstance(path, str) or not path.strip():
        raise InputError(
            f"{location} {number}: expected a column path with a file or URL (and, if you like, instance_id, licence, "
            f"camera), found {sorted(str(key) for key in row)}"
        )
    path = path.strip()
    values: dict[str, Any] = {name: str(row[name]).strip() for name in _COLUMNS[1:] if row.get(name) not in (None, "")}
    if is_url(path) or Path(path).is_absolute():
        name = PurePosixPath(path.split("://")[-1]).as_posix().lstrip("/")
        return {"path": path, "name": name, **values}
    return {"path": f"{base}/{path}" if base else path, "name": PurePosixPath(path).as_posix(), **values}


def _with_ids(rows: Sequence[Mapping[str, Any]]) -> tuple[PhotoFile, ...]:
    """Frame ids: the file's name without suffix where no other has it, else the path made one word, with a hash."""
    stems = Counter(PurePosixPath(row["name"]).stem for row in rows)
    names = Counter(row["name"] for row in rows)
    twice = next((name for name, count in names.items() if count > 1), None)
    if twice is not None:
        raise InputError(f"photograph {twice} is listed twice; list it once")
    return tuple(
        PhotoFile(
            location=row["path"],
            path=row["name"],
            frame_id=frame_id_of(row["name"], is_unique=stems[PurePosixPath(row["name"]).stem] == 1),
            instance_id=row.get("instance_id"),
            licence=row.get("licence"),
            camera=row.get("camera"),
        )
        for row in rows
    )


def frame_id_of(name: str, *, is_unique: bool) -> str:
    """A photograph's id: safe as a part of file names on every system."""
    pure = PurePosixPath(name)
    if is_unique and len(pure.stem) <= ID_LENGTH and _SAFE.fullmatch(pure.stem):
        return pure.stem
    plain = _ODD.sub("-", pure.with_suffix("").as_posix())[-(ID_LENGTH - 9) :].strip("-._") or "photo"
    return f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
