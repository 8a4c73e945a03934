"""Writing a CarPatch3D store: shards appear whole or not at all, and the same records give the same bytes.

A shard is written to a temporary file and renamed when it is complete. The manifest says "unfinished"
from the first moment to `close`; a store cut off in between opens with the shards that are there.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq

from carstudio.dataset.manifest import Manifest, Shard, read_manifest, write_manifest
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.schema import PICTURES, SCHEMA, check_id, table_from_records
from carstudio.errors import InputError
from carstudio.files import atomic_path, sha256_file

ROWS_PER_GROUP = 64  # what one random access reads
GROUPS_PER_SHARD = 16  # 1,024 patches: what an interruption can lose
SHARD_PATTERN = "part-*.parquet"


def _leaves(name: str) -> list[str]:
    """Parquet's names of a column's leaves."""
    if name in PICTURES:
        return [f"{name}.bytes", f"{name}.path"]
    return [f"{name}.list.element"] if pa.types.is_list(SCHEMA.field(name).type) else [name]


_LEAVES = [leaf for name in SCHEMA.names for leaf in _leaves(name)]
_SMALL_LEAVES = [leaf for leaf in _LEAVES if not leaf.endswith(".bytes")]
_COMPRESSION = {leaf: "zstd" if leaf in _SMALL_LEAVES else "none" for leaf in _LEAVES}


def write_tables(path: Path, schema: pa.Schema, tables: Iterable[pa.Table]) -> None:
    """Write a side table (verdicts, a split) atomically, a row group for each of `tables`, taken as they come."""
    with atomic_path(path) as partial, pq.ParquetWriter(partial, schema, compression="zstd") as writer:
        for table in tables:
            writer.write_table(table)


def shard_paths(folder: Path) -> list[Path]:
    """The whole shards of a store, in order."""
    return sorted((folder / "data").glob(SHARD_PATTERN))


@contextmanager
def _shard_writer(path: Path) -> Iterator[Callable[[list[PatchRecord]], None]]:
    """A function that adds one row group to the shard; the shard gets its name when the block ends well."""
    with (
        atomic_path(path) as partial,
        pq.ParquetWriter(
            partial,
            SCHEMA,
            compression=_COMPRESSION,
            use_dictionary=_SMALL_LEAVES,
            write_statistics=_SMALL_LEAVES,
        ) as writer,
    ):
        yield lambda records: writer.write_table(table_from_records(records), row_group_size=ROWS_PER_GROUP)


class StoreWriter:
    """Adds patches to a new store (`mode="create"`) or to one that exists (`mode="append"`).

    `create` on a store that never was finished goes on after its whole shards when both were given the same
    `resume_key`, and starts over otherwise; `has(patch_id)` tells which patches need not be made again. Leaving the
    `with` block by an exception keeps the whole shards and leaves the store unfinished.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        source: str,
        mode: str = "create",
        resume_key: str | None = None,
        groups_per_shard: int = GROUPS_PER_SHARD,
    ) -> None:
        assert mode in ("create", "append"), mode
        self.path = Path(path)
        self._rows_per_shard = ROWS_PER_GROUP * groups_per_shard
        previous = self._previous_manifest(mode)
        if mode == "create" and (resume_key is None or resume_key != previous.resume_key):
            for shard in shard_paths(self.path):
                shard.unlink()
        for leftover in (self.path / "data").glob(".part-*.partial.parquet"):
            leftover.unlink()
        sources = tuple(sorted({*previous.sources, source}))
        self._manifest = Manifest(sources, previous.shards, resume_key=resume_key)
        write_manifest(self.path, self._manifest)
        shards = shard_paths(self.path)
        self._num_shards = len(shards)
        self._ids = {patch_id for shard in shards for patch_id in _patch_ids(shard)}
        self._pending: list[PatchRecord] = []

    def _previous_manifest(self, mode: str) -> Manifest:
        if mode == "append":
            return read_manifest(self.path)
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path}: expected a folder for the store, found a file; choose another --out")
        if not self.path.exists() or not any(self.path.iterdir()):
            return Manifest(())
        if not (self.path / "manifest.json").is_file():
            raise InputError(
                f"{self.path}: holds other files and is no CarPatch3D store; choose an empty or a new folder"
            )
        previous = read_manifest(self.path)
        if previous.is_finished or previous.shards:
            raise InputError(
                f"{self.path}: already holds a finished store of {previous.num_patches} patches; "
                "choose another --out or remove the folder"
            )
        return previous

    def has(self, patch_id: str) -> bool:
        """Whether the store holds this patch already."""
        return patch_id in self._ids

    def ids(self) -> frozenset[str]:
        """Ids of all patches so far."""
        return frozenset(self._ids)

    def __len__(self) -> int:
        return len(self._ids)

    def append(self, record: PatchRecord) -> None:
        """Add one patch; `InputError` when its id is there already or no safe file name."""
        check_id(record.patch_id, "patch id")
        check_id(record.instance_id, f"instance id of patch {record.patch_id}")
        if record.patch_id in self._ids:
            raise InputError(f"{self.path}: patch {record.patch_id} is in the store already; ids must be unique")
        self._ids.add(record.patch_id)
        self._pending.append(record)
        if len(self._pending) == self._rows_per_shard:
            self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        path = self.path / "data" / f"part-{self._num_shards:05d}.parquet"
        with _shard_writer(path) as write_group:
            for start in range(0, len(self._pending), ROWS_PER_GROUP):
                write_group(self._pending[start : start + ROWS_PER_GROUP])
        self._pending = []
        self._num_shards += 1

    def close(self) -> None:
        """Write the last shard and the checksums: the store is finished."""
        self._flush()
        (self.path / "data").mkdir(exist_ok=True)
        finished = {shard.name: shard for shard in self._manifest.shards}
        shards = tuple(finished.get(path.name) or describe_shard(path) for path in shard_paths(self.path))
        write_manifest(self.path, Manifest(self._manifest.sources, shards, is_finished=True))

    def __enter__(self) -> "StoreWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()


def describe_shard(path: Path) -> Shard:
    """Name, rows and checksum of a shard on disk."""
    return Shard(path.name, pq.read_metadata(path).num_rows, sha256_file(path))


def _patch_ids(shard: Path) -> list[str]:
    ids: list[str] = pq.read_table(shard, columns=["patch_id"])["patch_id"].to_pylist()
    return ids
