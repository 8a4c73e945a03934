"""`duplicates.parquet`: which patches of a store show the same picture, byte for byte or nearly.

It holds what was measured (hash, thumbnail, groups); whether a repeated patch is kept is decided by the filters, and
the splits keep every group on one side. Groups are what hangs together by likeness, directly or through others.
"""

from collections import Counter
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from jaxtyping import Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from carstudio.dataset.fingerprints import (
    THUMBNAIL_BYTES,
    Fingerprints,
    Likeness,
    difference_hash,
    near_pairs,
    thumbnail,
)
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.reading import open_parquet, reading, sound
from carstudio.dataset.store import PatchStore
from carstudio.dataset.workers import ordered_map
from carstudio.dataset.writer import write_tables
from carstudio.errors import InputError
from carstudio.images import decode_image
from carstudio.progress import Report, silent

DUPLICATES = "duplicates.parquet"
_CHUNK = 64  # patches handed to a process at once
SCHEMA = pa.schema(
    [
        pa.field("patch_id", pa.string(), nullable=False),
        pa.field("group", pa.int64()),
        pa.field("kind", pa.string()),
        pa.field("repeats", pa.string()),
        pa.field("phash", pa.uint64()),
        pa.field("thumbnail", pa.binary()),
    ]
)

Pairs = Int[np.ndarray, "pairs 2"]


@dataclass(frozen=True)
class Duplicates:
    """Of every patch in store order: `group` (None: unique), and the earlier patch that it repeats (None: it is first).

    A patch repeats one that it is like itself, not only through others; a group may hold several that are first.
    """

    patch_id: tuple[str, ...]
    group: tuple[int | None, ...]
    kind: tuple[str | None, ...]  # "exact": the same bytes as another patch; "near"
    repeats: tuple[str | None, ...]

    def groups(self) -> dict[str, int]:
        """patch_id -> group, of those that have one."""
        return {patch: group for patch, group in zip(self.patch_id, self.group, strict=True) if group is not None}

    def firsts(self) -> dict[str, str]:
        """patch_id -> the patch that it repeats, of those that repeat one."""
        return {patch: first for patch, first in zip(self.patch_id, self.repeats, strict=True) if first is not None}

    def counts(self) -> dict[str, int]:
        """Groups, patches in groups by kind, patches that repeat another."""
        kinds = Counter(self.kind)
        repeating = sum(first is not None for first in self.repeats)
        groups = len(set(self.groups().values()))
        return {"groups": groups, "exact": kinds["exact"], "near": kinds["near"], "repeating": repeating}


def find_duplicates(
    store: PatchStore, likeness: Likeness | None = None, *, workers: int = 1, report: Report = silent
) -> Duplicates:
    """Look at every picture of a store and write `duplicates.parquet` beside its data.

    Pictures that cannot be decoded are only compared by their bytes.
    """
    sha256 = store.table(["sha256"])["sha256"].to_pylist()
    seen: list[tuple[int, bytes, float] | None] = []
    with closing(ordered_map(fingerprint, store.records(), workers=workers, chunk=_CHUNK)) as prints:
        for done, found in enumerate(prints, start=1):
            seen.append(found)
            if done % _CHUNK == 0 or done == len(store):
                report("looking at pictures", done, len(store), "")
    near = _near_pairs(seen, sha256, likeness or Likeness())
    duplicates = group_patches(store.patch_ids(kept=False), sha256, near)
    table = pa.table(
        {
            "patch_id": duplicates.patch_id,
            "group": duplicates.group,
            "kind": duplicates.kind,
            "repeats": duplicates.repeats,
            "phash": [None if found is None else found[0] for found in seen],
            "thumbnail": [None if found is None else found[1] for found in seen],
        },
        schema=SCHEMA,
    )
    with store.writing():
        write_tables(store.path / DUPLICATES, SCHEMA, [table])
    return duplicates


def fingerprint(record: PatchRecord) -> tuple[int, bytes, float] | None:
    """Hash, thumbnail and width / height of a patch; None where its picture is broken."""
    try:
        image = decode_image(record.image, name=record.patch_id)
    except InputError:
        return None
    return difference_hash(image), thumbnail(image).tobytes(), image.shape[1] / image.shape[0]


def _same_bytes(sha256: list[str]) -> list[int]:
    """For each patch the first with the same bytes, itself perhaps."""
    first: dict[str, int] = {}
    return [first.setdefault(digest, i) for i, digest in enumerate(sha256)]


def _near_pairs(seen: list[tuple[int, bytes, float] | None], sha256: list[str], likeness: Likeness) -> Pairs:
    """Of pictures with the same bytes only the first is compared: a thousand copies are no million pairs."""
    indices = sorted(i for i in set(_same_bytes(sha256)) if seen[i] is not None)
    rows = [found for found in (seen[i] for i in indices) if found is not None]
    prints = Fingerprints(
        np.array([row[0] for row in rows], np.uint64),
        np.frombuffer(b"".join(row[1] for row in rows), np.uint8).reshape(-1, THUMBNAIL_BYTES),
        np.array([row[2] for row in rows], np.float64),
    )
    return np.array(indices, np.int64)[near_pairs(prints, likeness)]


def group_patches(patch_ids: list[str], sha256: list[str], near: Pairs) -> Duplicates:
    """Groups, numbered by their first patch; `near` are the like pairs (i < j) of pictures with different bytes."""
    count, same = len(patch_ids), _same_bytes(sha256)
    ends = np.concatenate([near, np.stack([same, np.arange(count)], axis=1)]) if count else near
    graph = coo_array((np.ones(len(ends), bool), (ends[:, 0], ends[:, 1])), shape=(count, count))
    labels = connected_components(graph, directed=False)[1] if count else np.zeros(0, np.int64)
    sizes = np.bincount(labels, minlength=1)
    numbers: dict[int, int] = {}
    for label in labels[sizes[labels] > 1].tolist():
        numbers.setdefault(label, len(numbers))
    copies = Counter(same)
    group = tuple(numbers.get(label) for label in labels.tolist())
    kind = tuple(
        None if number is None else "exact" if copies[i] > 1 else "near" for number, i in zip(group, same, strict=True)
    )
    first = _first_alike(count, near)
    for copy, i in enumerate(same):
        if copy != i:
            first[copy] = i if first[i] is None else first[i]
    return Duplicates(tuple(patch_ids), group, kind, tuple(None if i is None else patch_ids[i] for i in first))


def _first_alike(count: int, near: Pairs) -> list[int | None]:
    """For each patch the earliest patch that it is like and that repeats none itself; None: it is such a patch."""
    earlier: dict[int, list[int]] = {}
    for i, j in near.tolist():
        earlier.setdefault(j, []).append(i)
    first: list[int | None] = [None] * count
    for j in sorted(earlier):
        first[j] = min((i for i in earlier[j] if first[i] is None), default=None)
    return first


def read_duplicates(store: PatchStore) -> Duplicates | None:
    """What `find_duplicates` wrote; None where nobody has looked for duplicates yet."""
    path = store.path / DUPLICATES
    if not path.is_file():
        return None
    file = open_parquet(path, SCHEMA)
    with reading(path):
        table = file.read(columns=["patch_id", "group", "kind", "repeats"])
    columns = sound(table, ("patch_id",), path).to_pydict()
    return Duplicates(*(tuple(columns[name]) for name in ("patch_id", "group", "kind", "repeats")))


def require_duplicates(store: PatchStore) -> Duplicates:
    """What `find_duplicates` wrote; `InputError` when it has not run since the store was made."""
    found = read_duplicates(store)
    if found is None:
        raise InputError(
            f"{store.path}: nobody has looked for duplicates; run `carstudio dataset duplicates {store.path}` first"
        )
    return found
