"""Checking a store against its checksums and against itself."""

import hashlib
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.schema import TUPLES, check_id
from carstudio.dataset.writer import describe_shard, shard_paths
from carstudio.errors import InputError
from carstudio.images import decode_image, image_size

if TYPE_CHECKING:
    from carstudio.dataset.store import PatchStore


def verify_store(store: "PatchStore") -> list[str]:
    """Every problem as one sentence that names the file or the patch."""
    problems = list(_shard_problems(store))
    if problems:
        return problems
    for record in store.records():
        problems += [f"patch {record.patch_id}: {problem}" for problem in record_problems(record)]
    known = set(store.patch_ids(kept=False))
    for patch_id in store.verdict_columns("patch_id")["patch_id"].to_pylist():
        if patch_id not in known:
            problems.append(f"verdicts.parquet: patch {patch_id} is not in the store")
    for name in store.split_names():
        unknown = store.split(name).keys() - known
        problems += [f"splits/{name}.parquet: patch {patch_id} is not in the store" for patch_id in sorted(unknown)]
    return problems


def _shard_problems(store: "PatchStore") -> Iterator[str]:
    if not store.manifest.is_finished:
        yield "manifest.json: the store is unfinished (its writing was interrupted); run the same command again"
    listed = {shard.name: shard for shard in store.manifest.shards}
    found = {path.name: path for path in shard_paths(store.path)}
    for name, shard in listed.items():
        if name not in found:
            yield f"data/{name}: missing"
        elif describe_shard(found[name]) != shard:
            yield f"data/{name}: sha256 differs from the manifest's; the file was changed or damaged"
    if store.manifest.is_finished:
        for name in found.keys() - listed.keys():
            yield f"data/{name}: not in the manifest"


def record_problems(record: PatchRecord) -> list[str]:
    """What is wrong with one record, apart from its place in a store."""
    problems: list[str] = []
    try:
        check_id(record.patch_id, "patch id")
        check_id(record.instance_id, "instance id")
        problems += _picture_problems(record)
    except InputError as error:
        problems.append(str(error))
    if hashlib.sha256(record.image).hexdigest() != record.sha256:
        problems.append("sha256 of the image differs from the column's")
    for name in TUPLES:
        values = getattr(record, name)
        if values is not None and not all(map(math.isfinite, values)):
            problems.append(f"{name} {values} is not finite")
    if record.box_size is not None and min(record.box_size) <= 0:
        problems.append(f"box_size {record.box_size} is not positive")
    if min(record.fx, record.fy) <= 0:
        problems.append(f"focal length ({record.fx}, {record.fy}) px is not positive")
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
