"""`carstudio dataset export --format legacy-json`: a store -> the authors' json, patches and masks.

What came from their files is written as it was: every record's text, every picture's bytes, and the whole json byte by
byte where all its records are exported. Patches of other sources get records made from the columns (`made.py`).
"""

import json
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from carstudio.dataset.export_folder import UNFINISHED, ExportSummary, Which, export_folder, write_once
from carstudio.dataset.legacy_json.fields import parse_record
from carstudio.dataset.legacy_json.made import Namer, dataset_name, made_mask, made_picture, made_record, obstacle
from carstudio.dataset.legacy_json.verbatim import Verbatim, unpack_extra
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.files import atomic_path, inside
from carstudio.progress import Report, silent


@dataclass(frozen=True)
class Entry:
    """One record and its pictures as they will lie in the folder."""

    json: str
    dataset_name: str
    text: str  # the record
    patch: tuple[str, bytes]  # path, relative to the json; content
    mask: tuple[str, bytes]
    origin: Verbatim | None  # None: made from columns


@dataclass(frozen=True)
class Surroundings:
    """What stood around the instances of a file: up to the first, after the last; None where that record is missing."""

    opening: str | None = None
    closing: str | None = None


class _JsonFile:
    """A json that grows record by record."""

    def __init__(self, text: TextIO, first: Entry, around: Surroundings) -> None:
        self.count = 0
        self._text = text
        self._is_made = first.origin is None
        if around.opening is not None and around.closing is not None:
            opening, self._closing = around.opening, around.closing
        else:
            opening = f'{{"dataset_name": {json.dumps(first.dataset_name)}, "instances": [\n'
            self._closing = "\n]}\n"
        text.write(opening)

    def add(self, entry: Entry) -> None:
        """Write one record."""
        if self._is_made != (entry.origin is None):
            raise InputError(
                f"{entry.json}: the store holds patches of the authors' file and others that would be called alike; "
                "export two stores"
            )
        if self.count:
            before = ",\n" if entry.origin is None else entry.origin.before
            self._text.write(before if before.strip() == "," else ", ")
        self._text.write(entry.text)
        self.count += 1

    def close(self) -> None:
        """Write what stands behind the records."""
        self._text.write(self._closing)


def export_legacy(store: PatchStore, out: Path, *, patches: Which = "kept", report: Report = silent) -> ExportSummary:
    """Write the store's patches in the authors' layout below `out`, a new or empty folder."""
    with export_folder(out):
        return _export(store, out, frozenset(store.patch_ids(kept=patches == "kept")), report)


def _export(store: PatchStore, out: Path, wanted: frozenset[str], report: Report) -> ExportSummary:
    around = _surroundings(store)
    left_out: Counter[str] = Counter()
    files: dict[str, _JsonFile] = {}
    namer = Namer()
    with ExitStack() as stack:
        for done, record in enumerate((r for r in store.records() if r.patch_id in wanted), start=1):
            report("export", done, len(wanted), record.patch_id)
            origin = unpack_extra(record.extra, where=f"patch {record.patch_id}")
            reason = obstacle(record) if origin is None else None
            if reason is not None:
                left_out[reason] += 1
                continue
            entry = _made_entry(record, namer) if origin is None else _verbatim_entry(record, origin)
            for path, data in (entry.patch, entry.mask):
                _write_picture(out, path, data)
            if entry.json not in files:
                partial = stack.enter_context(atomic_path(_json_path(out, entry.json)))
                text = stack.enter_context(partial.open("w", encoding="utf-8", newline=""))
                files[entry.json] = _JsonFile(text, entry, around.get(entry.json, Surroundings()))
            files[entry.json].add(entry)
        if not files:
            reasons = "; ".join(f"{count} x {reason}" for reason, count in left_out.items())
            raise InputError(f"{store.path}: no patch can be exported ({reasons or 'none is kept'})")
        for file in files.values():
            file.close()
    counts = {name: file.count for name, file in sorted(files.items())}
    return ExportSummary(out, counts, dict(left_out.most_common()))


def _surroundings(store: PatchStore) -> dict[str, Surroundings]:
    """Of every json whose records are in the store, kept or not."""
    found: dict[str, Surroundings] = {}
    for record in store.light_records():
        origin = unpack_extra(record.extra, where=f"patch {record.patch_id}")
        if origin is None:
            continue
        known = found.get(origin.json, Surroundings())
        opening = origin.before if origin.index == 0 else known.opening
        found[origin.json] = Surroundings(opening, origin.after or known.closing)
    return found


def _verbatim_entry(record: PatchRecord, origin: Verbatim) -> Entry:
    try:
        paths = parse_record(origin.text)
    except InputError as error:
        raise InputError(f"patch {record.patch_id}: its record in `extra` is broken: {error}") from error
    mask = record.mask if origin.mask_png is None else origin.mask_png
    if mask is None:
        raise InputError(f"patch {record.patch_id}: comes from the authors' files but has no mask; import them again")
    return Entry(origin.json, origin.dataset_name, origin.text, (paths.patch, record.image), (paths.mask, mask), origin)


def _made_entry(record: PatchRecord, namer: Namer) -> Entry:
    subset, stem = namer.name(record)
    value = made_record(record, stem)
    return Entry(
        f"{subset}.json",
        dataset_name(subset),
        json.dumps(value, allow_nan=False),
        (value["patch"], made_picture(record)),
        (value["mask"], made_mask(record)),
        None,
    )


def _json_path(out: Path, name: str) -> Path:
    path = inside(out, name)
    if path.parent != out.resolve() or path.suffix != ".json":
        raise InputError(f"json {name!r} in a patch's `extra`: expected a file name that ends in .json")
    return path


def _write_picture(out: Path, name: str, data: bytes) -> None:
    """Write a file that nobody else wants to be another; one that an interrupted export left is taken as it is."""
    path = inside(out, name)
    if path.suffix == ".json" or path.name == UNFINISHED:
        raise InputError(f"picture {name!r}: expected a name of a picture, such as patch/km_0100097004_patch.png")
    write_once(out, name, data)
