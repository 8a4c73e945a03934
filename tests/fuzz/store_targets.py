"""Targets: a store's manifest; a whole store (Parquet damaged in its bytes, or well-formed with hostile rows)."""

import json
import math
from dataclasses import asdict
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from carstudio.dataset.filters import FilterRecipe, judge
from carstudio.dataset.manifest import data_sha256, read_manifest, write_manifest
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.schema import LIGHT_COLUMNS, SCHEMA, check_id
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import StoreWriter, open_store
from carstudio.dataset.verdicts import VERDICT_SCHEMA
from carstudio.errors import InputError
from fuzz.edits import Files
from fuzz.target import Target, write_files
from training.toy import toy_record

MANIFEST, SHARD, ROWS = "manifest.json", "data/part-00000.parquet", "rows.json"


@cache
def _store_files() -> Files:
    """A store of three patches with verdicts and splits, as files."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "s"
        with StoreWriter(folder, source="toy") as writer:
            for view in range(3):
                writer.append(toy_record(view // 2, view, azimuth_deg=40.0 + 30.0 * view))
        store = open_store(folder)
        store.write_verdicts([judge(record, FilterRecipe()) for record in store.light_records()])
        write_splits(store)
        names = (MANIFEST, SHARD, "verdicts.parquet", "splits/instance.parquet")
        return {name: (folder / name).read_bytes() for name in names}


@cache
def _rows() -> list[dict[str, Any]]:
    """The rows of that store without their pictures, as JSON has them."""
    table = pq.read_table(pa.BufferReader(_store_files()[SHARD]), columns=list(LIGHT_COLUMNS))
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def manifest_seeds() -> list[Files]:
    """One of a finished store, one of a store whose writing was cut off."""
    whole = json.loads(_store_files()[MANIFEST])
    unfinished = {**whole, "is_finished": False, "resume_key": "ab" * 32, "shards": []}
    return [mend_manifest({MANIFEST: json.dumps(value, indent=1).encode()}) for value in (whole, unfinished)]


def mend_manifest(files: Files) -> Files:
    """Totals as the shards say, whatever they say."""
    try:
        value = json.loads(files[MANIFEST])
        value["num_patches"] = sum(shard["num_patches"] for shard in value["shards"])
        value["data_sha256"] = data_sha256((shard["name"], shard["sha256"]) for shard in value["shards"])
        return {**files, MANIFEST: json.dumps(value, indent=1).encode()}
    except (ValueError, TypeError, KeyError, RecursionError):
        return files


def read_a_manifest(files: Files, folder: Path) -> None:
    """Names stay in `data`, numbers are counts, and it can be written again."""
    write_files(files, folder)
    manifest = read_manifest(folder)
    for shard in manifest.shards:
        assert Path(shard.name).name == shard.name
        assert shard.name.startswith("part-")
        assert isinstance(shard.num_patches, int)
        assert shard.num_patches >= 0
        assert len(shard.sha256) == 64
    assert all(isinstance(source, str) for source in manifest.sources)
    assert isinstance(manifest.is_finished, bool)
    write_manifest(folder, manifest)
    assert read_manifest(folder) == manifest


def store_seeds() -> list[Files]:
    """The store's files; and its rows as text, to be damaged in their values."""
    files = _store_files()
    verdicts = pq.read_table(pa.BufferReader(files["verdicts.parquet"])).to_pylist()
    values = {ROWS: json.dumps(_rows()).encode(), "verdicts.json": json.dumps(verdicts).encode()}
    return [files, values, {SHARD: files[SHARD]}]


def assemble(files: Files, folder: Path) -> None:
    """Write a store; hostile rows get the pictures of the sound ones and a manifest that agrees."""
    sound = _store_files()
    write_files({**sound, **{name: data for name, data in files.items() if name in sound}}, folder)
    if ROWS not in files:
        return
    try:
        rows = json.loads(files[ROWS])
        pictures = pq.read_table(pa.BufferReader(sound[SHARD]), columns=["image", "mask", "depth"]).to_pylist()
        joined = [{**row, **pictures[i % len(pictures)]} for i, row in enumerate(rows)]
        pq.write_table(pa.Table.from_pylist(joined, schema=SCHEMA), folder / SHARD)
        verdicts = pa.Table.from_pylist(json.loads(files["verdicts.json"]), schema=VERDICT_SCHEMA)
        pq.write_table(verdicts, folder / "verdicts.parquet")
    except (ValueError, TypeError, RecursionError, pa.ArrowException, OverflowError, AttributeError, KeyError):
        raise InputError("these rows cannot be written as Parquet at all") from None


def check_record(record: PatchRecord) -> None:
    """What every record that is read promises."""
    check_id(record.patch_id, "patch")
    check_id(record.instance_id, "instance")
    numbers = [value for value in asdict(record).values() if isinstance(value, float)]
    tuples = (record.camera_offset, record.box2d, record.box_center, record.box_size, record.box_rotation)
    numbers += [number for values in tuples if values is not None for number in values]
    assert all(map(math.isfinite, numbers)), record
    assert min(record.fx, record.fy, record.crop_width, record.crop_height) > 0, record
    assert record.box_size is None or min(record.box_size) > 0, record


def read_store(files: Files, folder: Path) -> None:
    """Everything that is read from a store; each part may be refused by itself."""
    assemble(files, folder)
    store = open_store(folder)
    refusals = []
    for part in (store.verify, store.info, store.verdicts, lambda: store.split("instance"), lambda: _judge(folder)):
        try:
            part()
        except InputError as error:
            refusals.append(error)
    for patch_id in store.patch_ids(kept=False):
        try:
            record = store.record(patch_id)
            check_record(record)
            patch = record.decode()
            assert patch.image.shape[:2] == patch.mask.shape
            assert patch.camera.intrinsics.isfinite().all()
            assert patch.box is None or patch.box.corners().isfinite().all()
        except InputError as error:
            refusals.append(error)
    assert all(str(error).strip() for error in refusals)
    if refusals:
        raise refusals[0]


def _judge(folder: Path) -> None:
    for record in open_store(folder).light_records():
        judge(record, FilterRecipe())


STORE_TARGETS = (
    Target("manifest", manifest_seeds, read_a_manifest, mend_manifest),
    Target("store", store_seeds, read_store),
)
