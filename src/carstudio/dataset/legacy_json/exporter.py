"""`carstudio dataset export --format legacy-json`: a store -> the authors' json, patches and masks.

What came from their files is written as it was: every record's text, every picture's bytes, and the whole json where
all its records are in the store. Other patches get records made from the columns (`made.py`).
"""

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TextIO

from carstudio.dataset.legacy_json.made import Namer, dataset_name, made_mask, made_picture, made_record, obstacle
from carstudio.dataset.legacy_json.verbatim import Verbatim, unpack_extra
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.schema import check_id
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.files import atomic_path, inside, write_text
from carstudio.progress import Report, silent

UNFINISHED = ".unfinished-export"  # lies in the folder until the export is whole; the same command starts over


@dataclass(frozen=True)
class ExportSummary:
    """What an export wrote, and how many patches it left out for which reason."""

    out: Path
    files: dict[str, int]  # json -> records
    left_out: dict[str, int]


@dataclass(frozen=True)
class Entry:
    """One record and its pictures as they will lie in the folder."""

    json: str
    record: str  # JSON text
    patch: tuple[str, bytes]  # path, relative to the json; content
    mask: tuple[str, bytes]
    origin: Verbatim | None  # None: made from columns


def export_legacy(
    store: PatchStore, out: Path, *, patches: Literal["kept", "all"] = "kept", report: Report = silent
) -> ExportSummary:
    """Write the store's patches in the authors' layout below `out`, a new or empty folder."""
    _begin(out)
    frames = _file_frames(store)
    left_out: Counter[str] = Counter()
    written: dict[str, str] = {}  # path -> sha256 of what lies there
    ids = store.patch_ids(kept=patches == "kept")
    with ExitStack() as stack:
        files: dict[str, _JsonFile] = {}
        namer = Namer()
        for done, patch_id in enumerate(ids, start=1):
            record = store.record(patch_id)
            entry = _entry(record, namer)
            if isinstance(entry, str):
                left_out[entry] += 1
                continue
            if entry.json not in files:
                partial = stack.enter_context(atomic_path(inside(out, entry.json)))
                text = stack.enter_context(partial.open("w", encoding="utf-8", newline=""))
                files[entry.json] = _JsonFile(entry.json, text, frames.get(entry.json))
            for path, data in (entry.patch, entry.mask):
                _write_picture(out, path, data, written)
            files[entry.json].add(entry)
            report("export", done, len(ids), entry.json)
        if not files:
            raise InputError(f"{store.path}: nothing to export: {dict(left_out) or 'no kept patches'}")
        for file in files.values():
            file.close()
    (out / UNFINISHED).unlink()
    return ExportSummary(out, {name: file.count for name, file in sorted(files.items())}, dict(left_out.most_common()))
