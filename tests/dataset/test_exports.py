"""COCO and KITTI: what is exported reads back as the same boxes, masks and cameras."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from carstudio.cli import run
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.export_coco import export_coco
from carstudio.dataset.export_kitti import TILTED, export_kitti, label_line, tilt_rad
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.geometry.transforms import rotation_from_quaternion
from carstudio.images import encode_jpeg, read_image
from carstudio.perception.rle import encode_rle
from dataset.made_up_patches import made_up_record, made_up_store
from oracles.rle_slow import slow_mask

NO_BOX = {"box_center": None, "box_size": None, "box_yaw": None, "box_iou": None}
TILT = (np.cos(0.1), np.sin(0.1), 0.0, 0.0)  # by 0.2 rad about the camera's x axis


def some_records() -> list[PatchRecord]:
    records = [made_up_record(i) for i in range(6)]
    records[1] = replace(records[1], image=encode_jpeg(records[1].decode().image, quality=90))
    records[2] = replace(records[2], mask=None, licence="CC-BY-4.0")
    records[3] = replace(records[3], **NO_BOX)
    records[4] = replace(records[4], box_rotation=TILT)
    return records


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.1, 0.5, 1.0]))
def test_run_lengths_read_back_by_a_slow_decoder(height: int, width: int, seed: int, share: float) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < share
    value = encode_rle(mask)
    np.testing.assert_array_equal(slow_mask(value["size"], value["counts"]), mask)


def test_run_lengths_longer_than_one_character() -> None:
    mask = np.zeros((300, 200), bool)
    mask[20:250, 30:170] = True
    mask[100:120, 90:100] = False
    value = encode_rle(mask)
    np.testing.assert_array_equal(slow_mask(value["size"], value["counts"]), mask)


def test_coco_holds_the_stores_boxes_and_masks(tmp_path: Path) -> None:
    records = some_records()
    store = made_up_store(tmp_path / "s", records)
    summary = export_coco(store, tmp_path / "coco", patches="all")
    assert summary.files == {"annotations.json": 6}
    coco = json.loads((tmp_path / "coco" / "annotations.json").read_text())
    assert coco["categories"] == [{"id": 3, "name": "car", "supercategory": "vehicle"}]
    names = {licence["id"]: licence["name"] for licence in coco["licenses"]}
    for record, image, found in zip(records, coco["images"], coco["annotations"], strict=True):
        assert (tmp_path / "coco" / "images" / image["file_name"]).read_bytes() == record.image
        assert (image["width"], image["height"]) == (record.crop_width, record.crop_height)
        assert image["id"] == found["image_id"]
        assert names[image["license"]] == record.licence
        x, y, width, height = found["bbox"]
        frame = [x + record.crop_x0, y + record.crop_y0, x + width + record.crop_x0, y + height + record.crop_y0]
        np.testing.assert_allclose(frame, record.box2d, atol=1e-9)
        patch = record.decode()
        camera = image["carstudio"]["camera"]
        np.testing.assert_allclose(
            [camera[key] for key in ("fx", "fy", "cx", "cy")], patch.camera.intrinsics, rtol=1e-6
        )
        assert (found["iscrowd"], found["category_id"]) == (0, 3)
        ours = found["carstudio"]
        if record.mask is None:
            assert "segmentation" not in found
            assert found["area"] == pytest.approx(width * height)
        else:
            car = slow_mask(found["segmentation"]["size"], found["segmentation"]["counts"])
            np.testing.assert_array_equal(car, patch.mask == MaskValue.CAR)
            assert found["area"] == car.sum()
            unknown = slow_mask(ours["unknown"]["size"], ours["unknown"]["counts"])
            np.testing.assert_array_equal(unknown, patch.mask == MaskValue.UNKNOWN)
        if patch.box is None:
            assert ours["box3d"] is None
        else:
            rotation = rotation_from_quaternion(torch.tensor(ours["box3d"]["rotation"], dtype=torch.float64))
            np.testing.assert_allclose(rotation.numpy(), patch.box.rotation.numpy(), atol=1e-6)
            assert tuple(ours["box3d"]["center"]) == record.box_center


def test_kitti_builds_the_same_boxes_again(tmp_path: Path) -> None:
    records = [replace(made_up_record(i), score_2d=0.875) for i in range(8)]
    records[3] = replace(records[3], **NO_BOX)
    store = made_up_store(tmp_path / "s", records)
    out = tmp_path / "kitti"
    export_kitti(store, out, patches="all")
    index = list(csv.reader((out / "patches.csv").open()))
    assert index[0] == ["frame", "patch_id", "instance_id"]
    assert [row[1] for row in index[1:]] == [record.patch_id for record in records]
    again_path = tmp_path / "again"
    recipe = FilterRecipe(height_px=0.0, mask_ratio=0.0)
    build(
        BuildConfig("kitti-det", out, again_path, segmenter=f"precomputed:{out / 'mask_2'}", filters=recipe, workers=1)
    )
    again = list(open_store(again_path).records())
    assert len(again) == len(records)
    for before, after in zip(records, again, strict=True):
        shifted = np.array(before.box2d) - [before.crop_x0, before.crop_y0] * 2
        np.testing.assert_allclose(after.box2d, shifted, atol=1e-5)
        assert (after.crop_x0, after.crop_y0) == (0, 0)
        assert (after.crop_width, after.crop_height) == (before.crop_width, before.crop_height)
        np.testing.assert_array_equal(after.decode().image, before.decode().image)
        crop = before.decode().camera.intrinsics
        np.testing.assert_allclose(after.decode().camera.intrinsics, crop, rtol=1e-6)
        assert after.score_2d == before.score_2d
        if before.box_center is None:
            assert after.box_center is None
            continue
        assert after.box_center is not None
        np.testing.assert_allclose(after.box_center, before.box_center, atol=2e-6)
        np.testing.assert_allclose(after.box_size, before.box_size, atol=1e-6)
        assert after.box_yaw == pytest.approx(before.box_yaw, abs=1e-6)
        assert after.camera_offset == (0.0, 0.0, 0.0)


def test_a_label_by_hand() -> None:
    """A car of 4 x 1.5 x 2 m, 10 m ahead and 10 m to the right, heading right: seen at 45 degrees less than its yaw."""
    record = made_up_record(
        0, crop_x0=100, crop_y0=50, box2d=(100.5, 50.25, 160.0, 90.0), box_center=(10.0, 0.9, 10.0),
        box_size=(4.0, 1.5, 2.0), box_yaw=0.0, truncation=2.0, occlusion=1, source="kitti-mot",
    )  # fmt: skip
    assert label_line(record) == (
        "Car -1.00 1 -0.785398 0.500000 0.250000 60.000000 40.000000 1.500000 2.000000 4.000000 "
        "10.000000 1.650000 10.000000 0.000000"
    )
    assert label_line(replace(record, truncation=0.3, source="kitti-det")).startswith("Car 0.30 1 ")
    assert label_line(replace(record, extra='{"type": "Van"}', occlusion=None)).startswith("Van -1.00 3 ")


def test_kitti_leaves_tilted_boxes_out_and_makes_png_of_jpeg(tmp_path: Path) -> None:
    records = some_records()
    store = made_up_store(tmp_path / "s", records)
    summary = export_kitti(store, tmp_path / "kitti", patches="all")
    assert summary.left_out == {TILTED: 1}
    assert tilt_rad(records[4]) == pytest.approx(0.2, abs=1e-3)
    assert tilt_rad(records[0]) < 1e-3
    image = read_image(tmp_path / "kitti" / "image_2" / "000001.png")
    np.testing.assert_array_equal(image, records[1].decode().image)
    assert not (tmp_path / "kitti" / "mask_2" / "000002.png").exists()
    only = made_up_store(tmp_path / "t", [records[4]])
    with pytest.raises(InputError, match=r"no patch can be exported \(1 x 3-D box is not upright"):
        export_kitti(only, tmp_path / "none", patches="all")


@pytest.mark.parametrize("kind", ["coco", "kitti"])
def test_the_verb_refuses_other_folders_and_goes_on_in_its_own(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(6)))
    out = tmp_path / "out"
    command = ["dataset", "export", str(store.path), "--format", kind, "--out", str(out)]
    assert run([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"] == {}
    first = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert run(command) == 2
    assert "holds other files" in capsys.readouterr().err
    (out / ".unfinished-export").write_text("")
    sorted(out.rglob("*.png"))[0].unlink()
    assert run(command) == 0
    assert first == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    nothing = made_up_store(tmp_path / "n", [made_up_record(0)], recipe=FilterRecipe(depth_m=1.0))
    assert run(["dataset", "export", str(nothing.path), "--format", kind, "--out", str(tmp_path / "x")]) == 2
    assert "no patch can be exported" in capsys.readouterr().err
