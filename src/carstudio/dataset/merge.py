"""Several stores made one: rows as they are, pictures as the bytes that they are, in the order of the stores.

A patch that is in two of them with equal rows is taken once; verdicts stay what they were; splits are made anew.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from carstudio.dataset.runs import read_configs, write_run
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, StoreWriter, open_store
from carstudio.dataset.verdicts import VERDICT_SCHEMA, Verdict, verdicts_from_table
from carstudio.errors import InputError
from carstudio.progress import Report, silent

_VERDICTS_AT_ONCE = 4096


@dataclass(frozen=True)
class MergeSummary:
    """What a merge wrote."""

    out: Path
    patches: int
    kept: int
    repeated: int  # patches that a later store has as well, with equal rows
    splits: dict[str, dict[str, int]]


def merge_stores(paths: Sequence[Path], out: Path, *, report: Report = silent) -> MergeSummary:
    """Write the patches of all stores into a new store `out`; an interrupted merge goes on when it is run again.

    `InputError` before anything is written when a store is unfinished, or when a patch that two of them have differs.
    """
    if len(paths) < 2:
        raise InputError(f"merge needs two stores or more, found {len(paths)}")
    stores = [_open_finished(path, out) for path in paths]
    repeated = _repeated_ids(stores)
    _require_equal_rows(stores, repeated)
    _require_equal_verdicts(stores, repeated)
    sources = sorted({source for store in stores for source in store.manifest.sources})
    key = hashlib.sha256("\n".join(store.data_sha256 for store in stores).encode()).hexdigest()
    with StoreWriter(out, source=sources, resume_key=f"merge-{key}") as writer:
        configs = [config for path in paths for config in read_configs(path)]
        write_run(out, {"merge": [str(path) for path in paths], "configs": configs})
        total, done = sum(map(len, stores)), 0
        for store in stores:
            for record in store.records():
                done += 1
                if not writer.has(record.patch_id):  # repeated, or written before an interruption
                    writer.append(record)
                    report("merge", done, total, record.patch_id)
        writer.flush()
        written = open_store(out, lock=writer.lock)
        written.write_verdicts(_merged_verdicts(stores, repeated))
        splits = write_splits(written)
        kept = len(written.patch_ids())
    return MergeSummary(out, total - sum(repeated.values()), kept, sum(repeated.values()), splits)


def _open_finished(path: Path, out: Path) -> PatchStore:
    store = open_store(path)
    if not store.manifest.is_finished:
        raise InputError(f"{path}: the store is unfinished; run the command that wrote it again, then merge")
    if out.resolve() == path.resolve():
        raise InputError(f"--out {out}: is one of the stores to merge; choose a new folder")
    return store


def _repeated_ids(stores: Sequence[PatchStore]) -> dict[str, int]:
    """Patches of more than one store, and how often they come again."""
    counts = Counter(patch_id for store in stores for patch_id in store.patch_ids(kept=False))
    return {patch_id: count - 1 for patch_id, count in counts.items() if count > 1}


def _require_equal_rows(stores: Sequence[PatchStore], repeated: dict[str, int]) -> None:
    first: dict[str, PatchStore] = {}
    for store in stores:
        for patch_id in store.patch_ids(kept=False) if repeated else ():
            if patch_id not in repeated:
                continue
            before = first.setdefault(patch_id, store)
            a, b = before.record(patch_id), store.record(patch_id)
            if a != b:
                differing = ", ".join(name for name, value in vars(a).items() if value != getattr(b, name))
                raise InputError(
                    f"patch {patch_id}: {before.path} and {store.path} both have it, and they differ in {differing}; "
                    "a patch id must be unique: leave one of the stores out, or build it from other input"
                )


def _require_equal_verdicts(stores: Sequence[PatchStore], repeated: dict[str, int]) -> None:
    ids = pa.array(repeated, pa.string())
    first: dict[str, tuple[Verdict, Path]] = {}
    for store in stores if repeated else ():
        table = _verdict_table(store)
        for verdict in verdicts_from_table(table.filter(pc.is_in(table["patch_id"], ids))):
            before, path = first.setdefault(verdict.patch_id, (verdict, store.path))
            if before != verdict:
                raise InputError(
                    f"patch {verdict.patch_id}: {path} and {store.path} judge it differently ({before.reason}, "
                    f"{verdict.reason}) or by other thresholds; run `carstudio dataset refilter` on both with the same"
                )


def _merged_verdicts(stores: Sequence[PatchStore], repeated: dict[str, int]) -> Iterator[Verdict]:
    """The verdicts of all stores, those of repeated patches once."""
    seen: set[str] = set()
    for store in stores:
        table = _verdict_table(store)
        for start in range(0, len(table), _VERDICTS_AT_ONCE):
            for verdict in verdicts_from_table(table.slice(start, _VERDICTS_AT_ONCE)):
                if verdict.patch_id in seen:
                    continue
                if verdict.patch_id in repeated:
                    seen.add(verdict.patch_id)
                yield verdict


def _verdict_table(store: PatchStore) -> pa.Table:
    return store.verdict_columns(*VERDICT_SCHEMA.names)
