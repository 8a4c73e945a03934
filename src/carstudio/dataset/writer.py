"""Writing a CarPatch3D store: shards appear whole or not at all, and the same records give the same bytes.

A shard is written to a temporary file and renamed when it is complete. The manifest says "unfinished"
from the first moment to `close`; a store cut off in between opens with the shards that are there.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq

from carstudio.dataset.manifest import Manifest, Shard, read_manifest, write_manifest
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.reading import reading
from carstudio.dataset.schema import PICTURES, SCHEMA, check_id, table_from_records
from carstudio.errors import InputError
from carstudio.files import atomic_path, is_partial, remove_partials, sha256_file
from carstudio.locks import LOCK_NAME, FolderLock

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


def side_tables(folder: Path) -> list[Path]:
    """The verdicts, duplicates and splits of a store that are there."""
    tables = (folder / "verdicts.parquet", folder / "duplicates.parquet", *(folder / "splits").glob("*.parquet"))
    return [path for path in tables if path.exists()]


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
            write_page_checksum=True,  # a flipped byte is told when it is read, not only by `dataset verify`
        ) as writer,
    ):
        yield lambda records: writer.write_table(table_from_records(records), row_group_size=ROWS_PER_GROUP)


class StoreWriter:
    """Adds patches to a new store (`mode="create"`) or to one that exists (`mode="append"`).

    The store is locked against other writers until the writer is closed. `create` on a store that never was finished
    goes on after its whole shards when both were given the same `resume_key`, and starts over otherwise;
    `has(patch_id)` tells which patches need not be made again. Leaving the `with` block by an exception keeps the
    whole shards and leaves the store unfinished.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        source: str | Sequence[str],
        mode: str = "create",
        resume_key: str | None = None,
        groups_per_shard: int = GROUPS_PER_SHARD,
    ) -> None:
        assert mode in ("create", "append"), mode
        self.path = Path(path)
        self._rows_per_shard = ROWS_PER_GROUP * groups_per_shard
        self._previous_manifest(mode)  # refuses before anything is touched, the lock's file included
        self.lock = FolderLock(self.path)
        try:
            self._begin(source, mode, resume_key)
        except BaseException:
            self.lock.release()
            raise

    def _begin(self, source: str | Sequence[str], mode: str, resume_key: str | None) -> None:
        previous = self._previous_manifest(mode)
        remove_partials(self.path)
        if mode == "create" and (resume_key is None or resume_key != previous.resume_key):
            self._start_over(previous)
        sources = tuple(sorted({*previous.sources, *([source] if isinstance(source, str) else source)}))
        self._manifest = Manifest(sources, previous.shards, resume_key=resume_key)
        write_manifest(self.path, self._manifest)
        shards = shard_paths(self.path)
        self._num_shards = len(shards)
        self._ids = {patch_id for shard in shards for patch_id in _patch_ids(shard)}
        self._pending: list[PatchRecord] = []

    def _start_over(self, previous: Manifest) -> None:
        """Remove what another run left; a kill in between must not let that run go on with what is left of it."""
        write_manifest(self.path, Manifest(previous.sources, resume_key=None))
        for path in (*shard_paths(self.path), *side_tables(self.path)):
            path.unlink()

    def _previous_manifest(self, mode: str) -> Manifest:
        if mode == "append":
            return read_manifest(self.path)
        if self.path.exists() and not self.path.is_dir():
            raise InputError(f"{self.path}: expected a folder for the store, found a file; choose another --out")
        if not self.path.exists() or not any(_is_foreign(path) for path in self.path.iterdir()):
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
            self.flush()

    def flush(self) -> None:
        """Write what was added so far as a shard, a small one perhaps: the store can be read whole from here on."""
        if not self._pending:
            return
        path = self.path / "data" / f"part-{self._num_shards:05d}.parquet"
        with _shard_writer(path) as write_group:
            for start in range(0, len(self._pending), ROWS_PER_GROUP):
                write_group(self._pending[start : start + ROWS_PER_GROUP])
        self._pending = []
        self._num_shards += 1

    def close(self) -> None:
        """Write the last shard and the checksums: the store is finished, and others may write."""
        self.flush()
        (self.path / "data").mkdir(exist_ok=True)
        finished = {shard.name: shard for shard in self._manifest.shards}
        shards = tuple(finished.get(path.name) or describe_shard(path) for path in shard_paths(self.path))
        write_manifest(self.path, Manifest(self._manifest.sources, shards, is_finished=True))
        self.lock.release()

    def __enter__(self) -> "StoreWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.lock.release()


def _is_foreign(path: Path) -> bool:
    """Whether a file in a store's folder tells of something else: not so what a killed start leaves behind."""
    return path.name != LOCK_NAME and not is_partial(path)


def describe_shard(path: Path) -> Shard:
    """Name, rows and checksum of a shard on disk."""
    return Shard(path.name, count_patches(path), sha256_file(path))


def count_patches(shard: Path) -> int:
    """Patches in a shard on disk, from its last bytes."""
    with reading(shard):
        num_rows: int = pq.read_metadata(shard).num_rows
        return num_rows


def _patch_ids(shard: Path) -> list[str]:
    with reading(shard):
        ids: list[str] = pq.read_table(shard, columns=["patch_id"])["patch_id"].to_pylist()
        return ids
