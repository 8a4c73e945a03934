"""Reading a CarPatch3D store: a folder of Parquet that pandas, DuckDB and Hugging Face `datasets` open as well.

`data/` holds every candidate and never changes; verdicts and splits lie beside it, keyed by patch_id.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from carstudio.dataset.info import store_info
from carstudio.dataset.manifest import Manifest, data_sha256, read_manifest
from carstudio.dataset.patch import Patch, PatchRecord
from carstudio.dataset.reading import open_parquet, reading, sound
from carstudio.dataset.schema import (
    COLUMNS,
    LIGHT_COLUMNS,
    PICTURES,
    REQUIRED,
    SAFE_ID_PATTERN,
    SCHEMA,
    check_id,
    record_from_row,
)
from carstudio.dataset.soundness import value_problems
from carstudio.dataset.verdicts import VERDICT_SCHEMA, Verdict, table_from_verdicts, verdicts_from_table
from carstudio.dataset.verify import verify_store
from carstudio.dataset.writer import StoreWriter, describe_shard, shard_paths, write_tables
from carstudio.errors import InputError
from carstudio.locks import FolderLock

__all__ = ["PatchStore", "StoreWriter", "open_store"]

PARTS = ("train", "test")
_VERDICTS_PER_GROUP = 4096
_CACHED_GROUPS = 2  # row groups whose pictures are kept, so that reading in order decodes each group once


class Location(NamedTuple):
    """Where a patch lies: shard, row group in it, row in the group."""

    shard: int
    group: int
    row: int


def open_store(path: Path | str, *, lock: FolderLock | None = None) -> "PatchStore":
    """Open a store for reading; `InputError` when there is none or its format is newer than this program.

    Whoever holds the store's lock already (a `StoreWriter`) hands it over to write verdicts and splits as well.
    """
    return PatchStore(Path(path), read_manifest(Path(path)), lock)


class PatchStore:
    """A store opened for reading; what it reads is cached, so open it again after writing. Can be pickled."""

    def __init__(self, path: Path, manifest: Manifest, lock: FolderLock | None = None) -> None:
        self.path = path
        self._lock = lock
        self.manifest = manifest
        self._pictures = lru_cache(_CACHED_GROUPS)(self._read_pictures)
        self._light = lru_cache(None)(self._read_light)  # some 600 bytes per patch: not read twice

    def __reduce__(self) -> tuple[Any, ...]:
        return open_store, (self.path,)

    def __len__(self) -> int:
        """Number of candidates, kept or not."""
        return sum(file.metadata.num_rows for file in self._files)

    @cached_property
    def _paths(self) -> list[Path]:
        """The shards, which are those that the manifest lists; an unfinished store may hold more."""
        files = {path.name: path for path in shard_paths(self.path)}
        listed = {shard.name for shard in self.manifest.shards}
        missing, extra = sorted(listed - files.keys()), sorted(files.keys() - listed)
        if missing:
            raise InputError(f"{self.path}: shards {missing} are missing; restore them or rebuild the store")
        if extra and self.manifest.is_finished:
            raise InputError(f"{self.path}: data/ holds {extra}, which its manifest does not know; remove them")
        return list(files.values())

    @cached_property
    def _files(self) -> list[pq.ParquetFile]:
        opened = [open_parquet(path, SCHEMA) for path in self._paths]
        counts = {shard.name: shard.num_patches for shard in self.manifest.shards}
        for path, file in zip(self._paths, opened, strict=True):
            found, told = file.metadata.num_rows, counts.get(path.name)
            if told is not None and found != told:
                raise InputError(
                    f"{path}: holds {found} patches, the manifest says {told}; restore the one or the other"
                )
        return opened

    @cached_property
    def data_sha256(self) -> str:
        """One checksum for all shards (as the manifest lists them; computed for an unfinished store)."""
        if self.manifest.is_finished:
            return data_sha256((shard.name, shard.sha256) for shard in self.manifest.shards)
        return data_sha256((s.name, s.sha256) for s in map(describe_shard, shard_paths(self.path)))

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """Rows of all candidates in store order; by default every column but the pictures."""
        columns = list(LIGHT_COLUMNS) if columns is None else columns
        unknown = [name for name in columns if not self._files or name not in self._files[0].schema_arrow.names]
        if unknown and self._files:
            raise InputError(f"{self.path}: no column {unknown}; there are {self._files[0].schema_arrow.names}")
        if not self._files:
            return SCHEMA.empty_table().select(columns)
        with reading(self.path / "data"):
            table = pa.concat_tables([file.read(columns=columns) for file in self._files])
        return sound(table, REQUIRED, self.path / "data")

    def picture_names(self, picture: str) -> pa.ChunkedArray:
        """File names of the candidates' `image`, `mask` or `depth`, null where there is none; no bytes are read."""
        assert picture in PICTURES, picture
        with reading(self.path / "data"):
            tables = [file.read(columns=[f"{picture}.path"]) for file in self._files]
        chunks = [pc.struct_field(chunk, "path") for table in tables for chunk in table[picture].chunks]
        return pa.chunked_array(chunks, pa.string())

    @cached_property
    def _locations(self) -> dict[str, Location]:
        locations: dict[str, Location] = {}
        for shard, file in enumerate(self._files):
            path = self._paths[shard]
            with reading(path):
                column = file.read(columns=["patch_id"])
            ids = _file_names(sound(column, REQUIRED, path)["patch_id"]).to_pylist()
            counts = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
            if sum(counts) != len(ids):
                raise InputError(f"{path}: its row groups tell of {sum(counts)} patches, found {len(ids)}; restore it")
            start = 0
            for group in range(file.num_row_groups):
                stop = start + file.metadata.row_group(group).num_rows
                locations |= {ids[i]: Location(shard, group, i - start) for i in range(start, stop)}
                start = stop
        if len(locations) != len(self):
            raise InputError(
                f"{self.path}: {len(self)} patches have {len(locations)} different ids; restore the store or build it "
                "again"
            )
        return locations

    def patch_ids(self, *, kept: bool = True, split: str | None = None, part: str = "all") -> list[str]:
        """Ids in store order: kept ones only (a patch without a verdict counts as kept), of a split's part."""
        if part not in (*PARTS, "all"):
            raise InputError(f"part {part!r}: expected train, test or all")
        if part != "all" and split is None:
            raise InputError(f"part {part!r} needs the name of a split; this store has {self.split_names()}")
        ids: Iterable[str] = self._locations
        if kept:
            rejected = set(self._rejected().to_pylist())
            ids = (patch_id for patch_id in ids if patch_id not in rejected)
        if split is not None:
            parts = self.split(split)
            wanted = PARTS if part == "all" else (part,)
            ids = (patch_id for patch_id in ids if parts.get(patch_id) in wanted)
        return list(ids)

    def _read_pictures(self, shard: int, group: int) -> pa.Table:
        return self._read_group(shard, group, PICTURES)

    def _read_light(self, shard: int, group: int) -> pa.Table:
        return self._read_group(shard, group, LIGHT_COLUMNS)

    def _read_group(self, shard: int, group: int, columns: Iterable[str]) -> pa.Table:
        path = self._paths[shard]
        with reading(path):
            table = self._files[shard].read_row_group(group, columns=list(columns), use_threads=False)
        return sound(table, REQUIRED, path)

    def record(self, patch_id: str) -> PatchRecord:
        """One patch as stored; `InputError` when its numbers are none to compute with (infinite, not positive ...)."""
        location = self._locations.get(patch_id)
        if location is None:
            raise InputError(
                f"{self.path}: no patch {patch_id!r} among {len(self)}; `carstudio dataset info` lists them"
            )
        tables = (part(location.shard, location.group) for part in (self._light, self._pictures))
        light, pictures = (table.slice(location.row, 1).to_pylist()[0] for table in tables)
        record = record_from_row(light | pictures)
        problem = next(value_problems(record), None)
        if problem is not None:
            raise InputError(
                f"{self.path}: patch {patch_id}: {problem}; `carstudio dataset verify` lists all such patches"
            )
        return record

    def light_records(self) -> Iterator[PatchRecord]:
        """All candidates in store order without their pictures (`image` is empty): for filters."""
        for path, file in zip(self._paths, self._files, strict=True):
            with reading(path):
                table = file.read(columns=list(LIGHT_COLUMNS))
            yield from map(record_from_row, sound(table, REQUIRED, path).to_pylist())

    def records(self) -> Iterator[PatchRecord]:
        """All candidates in store order, kept or not, with their pictures; one row group is in memory at a time."""
        for shard, file in enumerate(self._files):
            for group in range(file.num_row_groups):
                yield from map(record_from_row, self._read_group(shard, group, COLUMNS).to_pylist())

    def patch(self, patch_id: str) -> Patch:
        """One patch decoded."""
        return self.record(patch_id).decode()

    def verdicts(self) -> list[Verdict]:
        """What the filters decided; empty when nobody judged yet."""
        path = self.path / "verdicts.parquet"
        return verdicts_from_table(_read_side_table(path, VERDICT_SCHEMA)) if path.is_file() else []

    def verdict_columns(self, *names: str) -> pa.Table:
        """Some columns of the verdicts, without the checks a fraction of their memory."""
        path = self.path / "verdicts.parquet"
        if not path.is_file():
            return VERDICT_SCHEMA.empty_table().select(names)
        return _read_side_table(path, VERDICT_SCHEMA, list(names))

    def _rejected(self) -> pa.ChunkedArray:
        table = self.verdict_columns("patch_id", "is_kept")
        return table.filter(pc.invert(table["is_kept"]))["patch_id"]

    def write_verdicts(self, verdicts: Iterable[Verdict]) -> None:
        """Replace the verdicts; `InputError` when one is about a patch that is not in the store.

        They are taken one by one and written in row groups: those of half a million patches need not be in memory.
        """

        def tables() -> Iterator[pa.Table]:
            left = iter(verdicts)
            while some := list(islice(left, _VERDICTS_PER_GROUP)):
                self._check_known((verdict.patch_id for verdict in some), "verdicts")
                yield table_from_verdicts(some)

        with self.writing():
            write_tables(self.path / "verdicts.parquet", VERDICT_SCHEMA, tables())

    def split_names(self) -> list[str]:
        """Names of the splits this store has."""
        return sorted(path.stem for path in (self.path / "splits").glob("*.parquet"))

    def split(self, name: str) -> dict[str, str]:
        """patch_id -> "train" or "test"."""
        table = self._split_table(name)
        return dict(zip(table["patch_id"].to_pylist(), table["part"].to_pylist(), strict=True))

    def _split_table(self, name: str) -> pa.Table:
        path = self.path / "splits" / f"{check_id(name, 'split name')}.parquet"
        if not path.is_file():
            raise InputError(f"{self.path}: no split {name!r}; there are {self.split_names()}")
        table = _read_side_table(path, _SPLIT_SCHEMA)
        unknown = set(table["part"].unique().to_pylist()) - set(PARTS)
        if unknown:
            raise InputError(f"{path}: part must be one of {PARTS}, found {sorted(unknown)[:4]}; write the split again")
        return table

    def write_split(self, name: str, parts: Mapping[str, str]) -> None:
        """Write split `name` (patch_id -> "train" or "test"), in store order."""
        check_id(name, "split name")
        self._check_known(parts, f"split {name}")
        assert set(parts.values()) <= set(PARTS), set(parts.values())
        ids = [patch_id for patch_id in self._locations if patch_id in parts]
        table = pa.table({"patch_id": ids, "part": [parts[patch_id] for patch_id in ids]}, schema=_SPLIT_SCHEMA)
        with self.writing():
            write_tables(self.path / "splits" / f"{name}.parquet", _SPLIT_SCHEMA, [table])

    def writing(self) -> AbstractContextManager[object]:
        """The store's lock, taken for one write unless its holder opened this store."""
        return nullcontext() if self._lock is not None and self._lock.is_held else FolderLock(self.path)

    def _check_known(self, patch_ids: Iterable[str], what: str) -> None:
        unknown = [patch_id for patch_id in patch_ids if patch_id not in self._locations]
        if unknown:
            raise InputError(
                f"{self.path}: {what} name {len(unknown)} patches that are not there, first {unknown[0]!r}"
            )

    def verify(self) -> list[str]:
        """Problems found by reading everything: checksums, pictures, sizes, boxes. Empty when the store is sound."""
        return verify_store(self)

    def info(self) -> dict[str, Any]:
        """Counts: patches, instances, per source, licence, camera and verdict reason, splits, sizes."""
        return store_info(self)


_SPLIT_SCHEMA = pa.schema(
    [pa.field("patch_id", pa.string(), nullable=False), pa.field("part", pa.string(), nullable=False)]
)


def _file_names(ids: pa.ChunkedArray) -> pa.ChunkedArray:
    """Patch ids that may name files: pictures of a patch are written under its id."""
    is_safe = pc.match_substring_regex(ids, SAFE_ID_PATTERN)
    if not pc.all(is_safe, min_count=0).as_py():
        check_id(ids.filter(pc.invert(is_safe))[0].as_py(), "patch id")
    return ids


def _read_side_table(path: Path, schema: pa.Schema, columns: list[str] | None = None) -> pa.Table:
    file = open_parquet(path, schema)
    with reading(path):
        table = file.read(columns=columns)
    return sound(table, schema.names, path)
