"""Checking a store against its checksums and against itself."""

import hashlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa

from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.reading import open_parquet, reading
from carstudio.dataset.soundness import value_problems
from carstudio.dataset.writer import count_patches, shard_paths
from carstudio.errors import InputError
from carstudio.files import sha256_file
from carstudio.images import decode_image, image_size

if TYPE_CHECKING:
    from carstudio.dataset.store import PatchStore


def verify_store(store: "PatchStore") -> list[str]:
    """Every problem as one sentence that names the file or the patch."""
    problems = list(_shard_problems(store))
    if problems:
        return problems
    for part in (_patch_problems, _verdict_problems, _split_problems, _duplicate_problems):
        try:
            problems.extend(part(store))
        except InputError as error:  # what cannot be read ends its part, not the others
            problems.append(str(error))
    return problems


def _patch_problems(store: "PatchStore") -> Iterator[str]:
    for record in store.records():
        yield from (f"patch {record.patch_id}: {problem}" for problem in record_problems(record))


def _verdict_problems(store: "PatchStore") -> Iterator[str]:
    known = set(store.patch_ids(kept=False))
    for patch_id in store.verdict_columns("patch_id")["patch_id"].to_pylist():
        if patch_id not in known:
            yield f"verdicts.parquet: patch {patch_id} is not in the store"


def _split_problems(store: "PatchStore") -> Iterator[str]:
    known = set(store.patch_ids(kept=False))
    for name in store.split_names():
        unknown = store.split(name).keys() - known
        yield from (f"splits/{name}.parquet: patch {patch_id} is not in the store" for patch_id in sorted(unknown))


def _duplicate_problems(store: "PatchStore") -> Iterator[str]:
    path = store.path / "duplicates.parquet"
    if not path.is_file():
        return
    file = open_parquet(path, pa.schema([pa.field("patch_id", pa.string())]))
    with reading(path):
        ids = file.read(columns=["patch_id"])["patch_id"].to_pylist()
    known = set(store.patch_ids(kept=False))
    yield from (
        f"duplicates.parquet: patch {patch_id} is not in the store" for patch_id in ids if patch_id not in known
    )


def _shard_problems(store: "PatchStore") -> Iterator[str]:
    if not store.manifest.is_finished:
        yield "manifest.json: the store is unfinished (its writing was interrupted); run the same command again"
    listed = {shard.name: shard for shard in store.manifest.shards}
    found = {path.name: path for path in shard_paths(store.path)}
    for name, shard in listed.items():
        if name not in found:
            yield f"data/{name}: missing"
        elif sha256_file(found[name]) != shard.sha256:
            yield f"data/{name}: sha256 differs from the manifest's; the file was changed or damaged"
        elif count_patches(found[name]) != shard.num_patches:
            yield f"data/{name}: holds {count_patches(found[name])} patches, the manifest says {shard.num_patches}"
    if store.manifest.is_finished:
        for name in found.keys() - listed.keys():
            yield f"data/{name}: not in the manifest"


def record_problems(record: PatchRecord) -> list[str]:
    """What is wrong with one record, apart from its place in a store."""
    problems = list(value_problems(record))
    try:
        problems += _picture_problems(record)
    except InputError as error:
        problems.append(str(error))
    if hashlib.sha256(record.image).hexdigest() != record.sha256:
        problems.append("sha256 of the image differs from the column's")
    return problems


def _picture_problems(record: PatchRecord) -> Iterator[str]:
    crop = (record.crop_width, record.crop_height)
    image = decode_image(record.image, name="image")
    if image.shape[1::-1] != crop:
        yield f"image is {image.shape[1::-1]} px, crop is {crop}"
    if record.mask is not None:
        mask = decode_image(record.mask, name="mask", mode="L")
        if mask.shape[::-1] != crop:
            yield f"mask is {mask.shape[::-1]} px, crop is {crop}"
        if not np.isin(mask, [int(value) for value in MaskValue]).all():
            yield f"mask holds values other than {[int(value) for value in MaskValue]}"
    if record.depth is not None and image_size(record.depth, name="depth") != crop:
        yield f"depth is {image_size(record.depth, name='depth')} px, crop is {crop}"
