"""The store: what goes in comes out, the same bytes every time, and a cut-off write leaves a valid store."""

import hashlib
import json
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from carstudio.dataset.manifest import FORMAT_VERSION
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.schema import COLUMNS, LIGHT_COLUMNS
from carstudio.dataset.store import StoreWriter, open_store
from carstudio.dataset.verdicts import Check, Verdict
from carstudio.errors import InputError
from carstudio.images import encode_depth, encode_jpeg, encode_png

CONTRACT = """patch_id, instance_id, frame_id, sequence_id, frame_index, source, image, mask, depth, frame_path,
frame_width, frame_height, crop_x0, crop_y0, crop_width, crop_height, fx, fy, cx, cy, camera_offset, camera_source,
box2d, box_center, box_size, box_yaw, box_rotation, score_2d, score_mask, score_3d, mask_ratio, box_iou, truncation,
occlusion, licence, sha256, extra"""


def make_record(index: int, **changes: object) -> PatchRecord:
    rng = np.random.default_rng(index)
    pixels = rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    image = encode_png(pixels) if index % 2 else encode_jpeg(pixels, quality=90)
    mask = rng.choice([int(value) for value in MaskValue], (12, 18)).astype(np.uint8)
    record = PatchRecord(
        patch_id=f"ko-{index:06d}-000",
        instance_id=f"car-{index // 3}",
        frame_id=f"{index:06d}",
        sequence_id=None if index % 4 else "0001",
        frame_index=index,
        source="kitti-det",
        image=image,
        mask=encode_png(mask) if index % 5 else None,
        depth=encode_depth(np.full((12, 18), 7.5, np.float32)) if index % 3 else None,
        frame_path=f"image_2/{index:06d}.png",
        frame_width=1242,
        frame_height=375,
        crop_x0=3,
        crop_y0=4,
        crop_width=18,
        crop_height=12,
        fx=721.5377,
        fy=721.5377,
        cx=609.5593,
        cy=172.854,
        camera_offset=(0.0598, -0.0004, 0.0027),
        camera_source="calib:P2",
        box2d=(3.2, 4.1, 20.9, 15.5),
        box_center=(0.1 * index, 1.0 / 3.0, 20.0),
        box_size=(4.2, 1.5, 1.8),
        box_yaw=-1.57,
        mask_ratio=0.7,
        licence="CC0-1.0",
        sha256=hashlib.sha256(image).hexdigest(),
        extra='{"type": "Car"}',
    )
    return replace(record, **changes)  # type: ignore[arg-type]


def write_store(path: Path, count: int, **options: int) -> list[PatchRecord]:
    records = [make_record(index) for index in range(count)]
    with StoreWriter(path, source="kitti-det", **options) as writer:  # type: ignore[arg-type]
        for record in records:
            writer.append(record)
    return records


def tree(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


@pytest.mark.parametrize("count", [0, 1, 64, 65, 130])
def test_records_come_back_as_they_went_in(tmp_path: Path, count: int) -> None:
    records = write_store(tmp_path / "s", count, groups_per_shard=1)
    store = open_store(tmp_path / "s")
    assert len(store) == count
    assert [store.record(record.patch_id) for record in records] == records
    assert store.patch_ids() == [record.patch_id for record in records]
    assert [replace(r, mask=None, depth=None, image=b"") for r in records] == list(store.light_records())
    assert store.verify() == []


def test_columns_are_the_contracts() -> None:
    assert tuple(CONTRACT.replace("\n", " ").split(", ")) == COLUMNS


def test_pyarrow_reads_it_without_our_code(tmp_path: Path) -> None:
    records = write_store(tmp_path / "s", 70, groups_per_shard=1)
    dataset = pyarrow.dataset.dataset(tmp_path / "s" / "data")
    assert dataset.count_rows() == 70
    rows = dataset.to_table().to_pylist()
    assert [row["image"]["bytes"] for row in rows] == [record.image for record in records]
    assert rows[0]["image"]["path"] == "ko-000000-000.jpg"
    assert rows[1]["image"]["path"] == rows[1]["mask"]["path"] == "ko-000001-000.png"
    assert rows[3]["box_center"] == list(records[3].box_center or ())
    assert rows[0]["mask"] is None


def test_parquet_is_laid_out_for_random_access(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 130)
    file = pq.ParquetFile(tmp_path / "s" / "data" / "part-00000.parquet")
    groups = [file.metadata.row_group(i) for i in range(file.num_row_groups)]
    assert [group.num_rows for group in groups] == [64, 64, 2]
    codecs = {groups[0].column(i).path_in_schema: groups[0].column(i).compression for i in range(groups[0].num_columns)}
    assert codecs["image.bytes"] == codecs["mask.bytes"] == codecs["depth.bytes"] == "UNCOMPRESSED"
    assert {codec for name, codec in codecs.items() if not name.endswith(".bytes")} == {"ZSTD"}
    features = json.loads(file.schema_arrow.metadata[b"huggingface"])["info"]["features"]
    assert features["image"] == {"_type": "Image"}
    assert list(features) == list(COLUMNS)


def test_same_records_give_same_bytes(tmp_path: Path) -> None:
    write_store(tmp_path / "a", 100)
    write_store(tmp_path / "b", 100)
    assert tree(tmp_path / "a") == tree(tmp_path / "b")
    assert open_store(tmp_path / "a").data_sha256 == open_store(tmp_path / "b").data_sha256
    write_store(tmp_path / "c", 99)
    assert open_store(tmp_path / "a").data_sha256 != open_store(tmp_path / "c").data_sha256


def test_data_sha256_is_what_sha256sum_prints(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 130, groups_per_shard=1)
    shards = sorted((tmp_path / "s" / "data").iterdir())
    lines = "".join(f"{hashlib.sha256(shard.read_bytes()).hexdigest()}  {shard.name}\n" for shard in shards)
    store = open_store(tmp_path / "s")
    assert store.data_sha256 == hashlib.sha256(lines.encode()).hexdigest()
    assert store.data_sha256 == json.loads((tmp_path / "s" / "manifest.json").read_text())["data_sha256"]


def write_and_fail(path: Path, count: int) -> None:
    with StoreWriter(path, source="kitti-det", groups_per_shard=1, resume_key="a") as writer:
        for index in range(count):
            writer.append(make_record(index))
        raise RuntimeError


def test_an_exception_keeps_the_whole_shards(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with pytest.raises(RuntimeError):
        write_and_fail(path, 100)
    store = open_store(path)
    assert len(store) == 64
    assert not store.manifest.is_finished
    assert store.record("ko-000063-000") == make_record(63)
    assert store.verify() == [
        "manifest.json: the store is unfinished (its writing was interrupted); run the same command again"
    ]


def _write_and_die(path: Path) -> None:
    """Killed while the second shard is being written: its bytes are on disk under a temporary name."""
    import carstudio.dataset.writer as writer_module

    real_table = writer_module.table_from_records
    calls = []

    def dying_table(records: list[PatchRecord]) -> pa.Table:
        calls.append(1)
        if len(calls) == 4:
            os.kill(os.getpid(), signal.SIGKILL)
        return real_table(records)

    writer_module.table_from_records = dying_table
    with StoreWriter(path, source="kitti-det", groups_per_shard=2, resume_key="k") as writer:
        for index in range(300):
            writer.append(make_record(index))


def test_a_kill_leaves_a_store_that_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "s"
    assert subprocess.run([sys.executable, __file__, str(path)], check=False).returncode == -signal.SIGKILL
    store = open_store(path)
    assert len(store) == 128
    assert pyarrow.dataset.dataset(path / "data").count_rows() == 128
    assert [name for name in os.listdir(path / "data") if name.startswith(".")] != []
    with StoreWriter(path, source="kitti-det", groups_per_shard=2, resume_key="k") as writer:
        assert writer.has("ko-000127-000")
        for index in range(300):
            if not writer.has(f"ko-{index:06d}-000"):
                writer.append(make_record(index))
    with StoreWriter(tmp_path / "whole", source="kitti-det", groups_per_shard=2, resume_key="k") as writer:
        for index in range(300):
            writer.append(make_record(index))
    assert tree(path) == tree(tmp_path / "whole")
    assert open_store(path).verify() == []


def test_an_unfinished_store_starts_over_with_another_key(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with pytest.raises(RuntimeError):
        write_and_fail(path, 64)
    with StoreWriter(path, source="kitti-det", groups_per_shard=1, resume_key="b") as writer:
        assert len(writer) == 0
        writer.append(make_record(500))
    assert open_store(path).patch_ids() == ["ko-000500-000"]


def test_what_kills_left_is_cleared_and_is_no_foreign_file(tmp_path: Path) -> None:
    """A kill during the very first write leaves a folder with hidden files and no manifest."""
    path = tmp_path / "s"
    path.mkdir()
    for name in (".lock", ".manifest-abc_1234.partial.json"):
        (path / name).touch()
    write_store(path, 3)
    assert [name for name in tree(path) if "/." in f"/{name}"] == []
    write_store(tmp_path / "whole", 3)
    assert tree(path) == tree(tmp_path / "whole")


def test_starting_over_can_be_killed_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of another run's shards are gone when the kill comes: that run must not go on with the other half."""
    path = tmp_path / "s"
    with pytest.raises(RuntimeError):
        write_and_fail(path, 200)
    real, gone = Path.unlink, []

    def dying_unlink(self: Path, missing_ok: bool = False) -> None:
        if self.name.startswith("part-"):
            if gone:
                raise KeyboardInterrupt
            gone.append(self)
        real(self, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", dying_unlink)
        with pytest.raises(KeyboardInterrupt):
            StoreWriter(path, source="kitti-det", groups_per_shard=1, resume_key="b")
    assert len(open_store(path)) == 128
    with StoreWriter(path, source="kitti-det", groups_per_shard=1, resume_key="a") as writer:
        assert len(writer) == 0


def test_append_adds_shards_and_leaves_the_others_alone(tmp_path: Path) -> None:
    path = tmp_path / "s"
    write_store(path, 70)
    before = tree(path / "data")
    with StoreWriter(path, source="kitti-mot", mode="append") as writer:
        with pytest.raises(InputError, match=r"patch ko-000003-000 is in the store already"):
            writer.append(make_record(3))
        writer.append(make_record(70))
    store = open_store(path)
    assert len(store) == 71
    assert store.manifest.sources == ("kitti-det", "kitti-mot")
    assert before.items() <= tree(path / "data").items()
    assert store.verify() == []


def test_writer_refuses_what_is_not_its_own(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="holds other files and is no CarPatch3D store"):
        StoreWriter(tmp_path / "photos", source="kitti-det")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="expected a folder for the store, found a file"):
        StoreWriter(tmp_path / "file", source="kitti-det")
    write_store(tmp_path / "s", 3)
    before = tree(tmp_path / "s")
    with pytest.raises(InputError, match="already holds a finished store of 3 patches"):
        StoreWriter(tmp_path / "s", source="kitti-det", resume_key="k")
    assert tree(tmp_path / "s") == before
    with pytest.raises(InputError, match=r"no CarPatch3D store \(no manifest.json\)"):
        StoreWriter(tmp_path / "none", source="kitti-det", mode="append")


@pytest.mark.parametrize("name", ["../up", "a/b", "", ".hidden", "a b", "end.", "x" * 101, "nul\0"])
def test_ids_must_be_file_names(tmp_path: Path, name: str) -> None:
    with StoreWriter(tmp_path / "s", source="kitti-det") as writer:
        with pytest.raises(InputError, match="patch id"):
            writer.append(make_record(0, patch_id=name))
        with pytest.raises(InputError, match="instance id of patch"):
            writer.append(make_record(0, instance_id=name))
    assert len(open_store(tmp_path / "s")) == 0


def test_open_store_explains_what_it_cannot_open(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no CarPatch3D store"):
        open_store(tmp_path)
    write_store(tmp_path / "s", 3)
    manifest = tmp_path / "s" / "manifest.json"
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(content | {"format_version": FORMAT_VERSION + 1}))
    with pytest.raises(InputError, match=f"format version {FORMAT_VERSION + 1}, this program reads up to"):
        open_store(tmp_path / "s")
    manifest.write_text(json.dumps({"format": "carpatch3d", "format_version": 1}))
    with pytest.raises(InputError, match="broken manifest"):
        open_store(tmp_path / "s")
    manifest.write_text("[]")
    with pytest.raises(InputError, match="another kind of manifest"):
        open_store(tmp_path / "s")
    manifest.write_text(json.dumps(content))
    (tmp_path / "s" / "data" / "part-00000.parquet").write_bytes(b"no parquet")
    with pytest.raises(InputError, match="expected a whole Parquet file"):
        len(open_store(tmp_path / "s"))
    (tmp_path / "s" / "data" / "part-00000.parquet").unlink()
    with pytest.raises(InputError, match="are missing"):
        len(open_store(tmp_path / "s"))


def test_unknown_names_are_input_errors(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 3)
    store = open_store(tmp_path / "s")
    with pytest.raises(InputError, match="no patch 'x' among 3"):
        store.record("x")
    with pytest.raises(InputError, match="no split 'view'"):
        store.patch_ids(split="view", part="test")
    with pytest.raises(InputError, match="needs the name of a split"):
        store.patch_ids(part="test")
    with pytest.raises(InputError, match="no column"):
        store.table(["colour"])
    with pytest.raises(InputError, match="verdicts name 1 patches that are not there"):
        store.write_verdicts([Verdict("x", True)])


def test_verdicts_and_splits_select_patches_in_store_order(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 5)
    store = open_store(tmp_path / "s")
    ids = store.patch_ids()
    verdicts = [
        Verdict(ids[4], False, "height_px", ("height_px", "x"), (Check("height_px", 3.5, 64.0, False),)),
        Verdict(ids[1], True, checks=(Check("type", None, None, True),)),
    ]
    store.write_verdicts(verdicts)
    assert store.verdicts() == verdicts
    assert store.patch_ids() == ids[:4]
    assert store.patch_ids(kept=False) == ids
    store.write_split("mine", {ids[2]: "test", ids[0]: "train", ids[4]: "test"})
    assert store.patch_ids(split="mine") == [ids[0], ids[2]]
    assert store.patch_ids(split="mine", part="test") == [ids[2]]
    assert store.patch_ids(split="mine", part="test", kept=False) == [ids[2], ids[4]]
    info = store.info()
    assert (info["patches"], info["kept"], info["unjudged"], info["instances"]) == (5, 4, 3, 2)
    assert info["splits"] == {"mine": {"test": 2, "train": 1}}
    assert sum(info["crop_height_px"].values()) == 5


def test_table_leaves_pictures_out_unless_asked(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 3)
    store = open_store(tmp_path / "s")
    assert tuple(store.table().column_names) == LIGHT_COLUMNS
    assert store.table(["patch_id", "image"]).column_names == ["patch_id", "image"]


def test_store_can_be_sent_to_another_process(tmp_path: Path) -> None:
    records = write_store(tmp_path / "s", 3)
    store = pickle.loads(pickle.dumps(open_store(tmp_path / "s")))
    assert store.record(records[2].patch_id) == records[2]


def test_patch_is_decoded(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 2)
    patch = open_store(tmp_path / "s").patch("ko-000001-000")
    assert patch.image.shape == (12, 18, 3)
    assert set(np.unique(patch.mask)) <= set(MaskValue)
    assert patch.depth_m is not None
    np.testing.assert_allclose(patch.depth_m, 7.5)
    np.testing.assert_allclose(patch.camera.intrinsics, [721.5377, 721.5377, 606.5593, 168.854], rtol=1e-6)


BAD_RECORDS = {
    "sha256 of the image differs": {"sha256": "0" * 64},
    "mask is (3, 2) px, crop is (18, 12)": {"mask": encode_png(np.zeros((2, 3), np.uint8))},
    "mask holds values other than": {"mask": encode_png(np.full((12, 18), 7, np.uint8))},
    "image is (18, 12) px, crop is (18, 13)": {"crop_height": 13, "mask": None, "depth": None},
    "box_center (nan, 0.0, 1.0) is not finite": {"box_center": (float("nan"), 0.0, 1.0)},
    "box_size (4.0, 0.0, 1.0) is not positive": {"box_size": (4.0, 0.0, 1.0)},
    "focal length (0.0, 721.5377) px is not positive": {"fx": 0.0},
    "image: expected an image": {"image": b"no picture"},
    "depth is (1, 1) px, crop is (18, 12)": {"depth": encode_depth(np.ones((1, 1), np.float32))},
}


@pytest.mark.parametrize(("problem", "changes"), BAD_RECORDS.items())
def test_verify_finds_bad_records(tmp_path: Path, problem: str, changes: dict[str, object]) -> None:
    with StoreWriter(tmp_path / "s", source="kitti-det") as writer:
        writer.append(make_record(0))
        writer.append(make_record(1, **changes))
    problems = open_store(tmp_path / "s").verify()
    assert any(found.startswith("patch ko-000001-000: ") and problem in found for found in problems), problems
    assert not any("ko-000000" in found for found in problems)


def test_verify_finds_a_flipped_bit(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 3)
    shard = tmp_path / "s" / "data" / "part-00000.parquet"
    data = bytearray(shard.read_bytes())
    data[200] ^= 1
    shard.write_bytes(data)
    (tmp_path / "s" / "data" / "part-00001.parquet").write_bytes(data)
    assert open_store(tmp_path / "s").verify() == [
        "data/part-00000.parquet: sha256 differs from the manifest's; the file was changed or damaged",
        "data/part-00001.parquet: not in the manifest",
    ]


@pytest.mark.slow
def test_pandas_duckdb_and_hugging_face_read_it(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    duckdb = pytest.importorskip("duckdb")
    datasets = pytest.importorskip("datasets")
    records = write_store(tmp_path / "s", 70, groups_per_shard=1)
    data = tmp_path / "s" / "data"
    store = open_store(tmp_path / "s")
    store.write_verdicts([Verdict(record.patch_id, record.frame_index != 1) for record in records])
    frame = pandas.read_parquet(data)
    assert list(frame["patch_id"]) == [record.patch_id for record in records]
    assert frame["image"][5]["bytes"] == records[5].image
    query = f"""select count(*), sum(d.box_center[3]) from '{data}/part-*.parquet' d
                join '{tmp_path}/s/verdicts.parquet' v using (patch_id) where v.is_kept"""
    assert duckdb.sql(query).fetchall() == [(69, 69 * 20.0)]
    cache = str(tmp_path / "cache")
    loaded = datasets.load_dataset("parquet", data_files=f"{data}/part-*.parquet", split="train", cache_dir=cache)
    assert loaded.num_rows == 70
    picture = loaded[1]["image"]
    np.testing.assert_array_equal(np.asarray(picture), store.patch("ko-000001-000").image)
    assert loaded[1]["box_size"] == [4.2, 1.5, 1.8]
    assert loaded[0]["mask"] is None


if __name__ == "__main__":
    _write_and_die(Path(sys.argv[1]))


def test_records_one_after_the_other_are_the_records_by_id(tmp_path: Path) -> None:
    records = write_store(tmp_path / "s", 150, groups_per_shard=1)
    store = open_store(tmp_path / "s")
    assert list(store.records()) == records == [store.record(record.patch_id) for record in records]


def test_a_damaged_shard_is_told_while_records_are_read_in_order(tmp_path: Path) -> None:
    write_store(tmp_path / "s", 30)
    shard = tmp_path / "s" / "data" / "part-00000.parquet"
    whole, rng = shard.read_bytes(), np.random.default_rng(0)
    messages = []
    for _ in range(150):
        data = bytearray(whole)
        data[int(rng.integers(4, len(whole) - 8))] ^= 1 << int(rng.integers(8))
        shard.write_bytes(bytes(data))
        for read in (lambda: list(open_store(tmp_path / "s").records()), lambda: open_store(tmp_path / "s").info()):
            try:
                read()
            except InputError as error:
                messages.append(str(error))
    assert len(messages) > 5
    assert all(str(shard.parent) in message for message in messages)
