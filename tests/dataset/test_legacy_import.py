"""The authors' files -> CarPatch3D: what the columns say, against the formulas written out in numpy."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from carstudio.dataset import writer
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.judging import judge_store
from carstudio.dataset.legacy_json.names import identify
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.sources.kitti_format import parse_calibration
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.rendering.rays import image_rays, to_canonical
from dataset.authors_files import KITTI, KITTI_T, as_numbers, make_record, make_records, write_all, write_subset
from oracles import released_formulas


def import_files(root: Path, out: Path, **changes: object) -> PatchStore:
    config = BuildConfig(source="legacy-json", root=root, out=out, workers=1)
    summary = build(replace(config, **changes))  # type: ignore[arg-type]
    assert summary.problems == ()
    return open_store(out)


@pytest.fixture(scope="module")
def authors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_all(tmp_path_factory.mktemp("authors") / "car_studio")


@pytest.fixture(scope="module")
def store(authors: Path, tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return import_files(authors, tmp_path_factory.mktemp("imported") / "store")


def test_every_subset_arrives_with_its_cars(store: PatchStore) -> None:
    records = {record.patch_id: record for record in store.light_records()}
    assert store.verify() == []
    assert list(records) == [
        "km-0001-000097-004", "km-0001-000098-004", "km-0001-000097-011", "km-0020-000003-004",
        "ko-000003-00000", "ko-000003-00001", "ko-007480-12345",
        "dv-000000-000017", "dv-000001-000017", "dv-000002-123456",
        "vk-0018-000000-007", "vk-0018-000001-007", "vk-0002-000001-007",
        "ns-0012-000003-00001", "ns-0012-000004-00001", "ns-0849-000003-00002",
    ]  # fmt: skip
    cars = {name: record.instance_id for name, record in records.items()}
    assert cars["km-0001-000097-004"] == cars["km-0001-000098-004"] == "km-0001-004"  # (sequence, track)
    assert cars["km-0020-000003-004"] == "km-0020-004"
    assert cars["vk-0018-000001-007"] == "vk-0018-007"
    assert cars["dv-000000-000017"] == cars["dv-000001-000017"] == "dv-000017"  # the advert
    assert all(cars[name] == name for name in cars if name[:2] in ("ko", "ns"))  # no identity across images
    record = records["km-0001-000098-004"]
    assert (record.frame_id, record.sequence_id, record.frame_index) == ("km-0001-000098", "0001", 98)
    assert {record.source for record in records.values()} == {"legacy-json"}
    assert records["ko-000003-00000"].licence == record.licence == "CC-BY-NC-SA-3.0 (KITTI)"


def test_columns_say_what_the_record_says(store: PatchStore) -> None:
    value = as_numbers(make_records("km")[2])
    record = store.record("km-0001-000097-011")
    assert (record.fx, record.fy, record.cx, record.cy) == tuple(KITTI.values())
    assert record.box2d == tuple(value[key] for key in ("xmin", "ymin", "xmax", "ymax"))
    assert record.box_size == (value["length"], value["height"], value["width"])
    assert record.box_yaw == value["yaw"]
    assert (record.frame_width, record.frame_height) == (1242, 375)
    assert record.frame_path == value["image_file"] == "Straße/\\u8eca \U0001f697.png"
    offset = released_formulas.offset(value)
    np.testing.assert_allclose(record.camera_offset, offset, rtol=1e-12)
    bottom = np.array([value["obj_x"], value["obj_y"], value["obj_z"]])
    np.testing.assert_allclose(record.box_center, bottom + offset - [0, value["height"] / 2, 0], rtol=1e-12)
    assert record.box_iou == pytest.approx(1.0, abs=1e-6)  # the made-up box is the projection of the whole P2


def test_crops_are_the_truncated_box_with_both_ends(authors: Path, store: PatchStore) -> None:
    for subset in ("km", "ko", "dv", "vk", "ns"):
        values = json.loads((authors / f"{subset}.json").read_text(encoding="utf-8"))["instances"]
        records = [record for record in store.records() if record.patch_id.startswith(subset)]
        assert len(values) == len(records)
        for value, record in zip(values, records, strict=True):
            frame = np.zeros((375, 1242, 3), np.uint8)
            x0, y0, x1, y1 = (int(value[key]) for key in ("xmin", "ymin", "xmax", "ymax"))
            patch = np.asarray(Image.open(authors / value["patch"]))
            frame[y0 : y1 + 1, x0 : x1 + 1] = patch  # does not broadcast: fails when a size differs
            window = (record.crop_x0, record.crop_y0, record.crop_width, record.crop_height)
            assert window == (x0, y0, x1 + 1 - x0, y1 + 1 - y0)
            np.testing.assert_array_equal(store.patch(record.patch_id).image, patch)


def test_any_value_that_is_not_zero_is_car(authors: Path, store: PatchStore) -> None:
    for record in store.records():
        path = json.loads(record.extra)["record"]["mask"]
        pixels = np.asarray(Image.open(authors / path))
        is_car = pixels.reshape(*pixels.shape[:2], -1).sum(axis=-1) > 0
        mask = store.patch(record.patch_id).mask
        np.testing.assert_array_equal(mask, np.where(is_car, MaskValue.CAR, MaskValue.BACKGROUND))
        assert record.mask_ratio == pytest.approx(is_car.mean())


def test_only_foreign_masks_are_kept_twice(store: PatchStore) -> None:
    for record in store.light_records():
        assert ("mask_png" in json.loads(record.extra)) == (record.patch_id[:2] in ("vk", "ns"))


def test_the_size_of_the_photograph_may_be_missing(store: PatchStore) -> None:
    for record in store.light_records():
        is_told = not record.patch_id.startswith("ko")
        assert (record.frame_width is not None) == (record.box_iou is not None) == is_told
    patch = store.patch("ko-000003-00000")
    assert (patch.camera.width, patch.camera.height) == patch.image.shape[1::-1]


def double(store: PatchStore, patch_id: str) -> tuple[Camera, Box3D]:
    """Camera of the crop and box in float64."""
    record = store.record(patch_id)
    assert record.box_center is not None
    assert record.box_size is not None
    assert record.box_yaw is not None
    intrinsics = torch.tensor([record.fx, record.fy, record.cx, record.cy], dtype=torch.float64)
    camera = Camera(intrinsics, 0, 0).crop(record.crop_x0, record.crop_y0, record.crop_width, record.crop_height)
    center, size, yaw = (
        torch.tensor(x, dtype=torch.float64) for x in (record.box_center, record.box_size, record.box_yaw)
    )
    return camera, Box3D(center, size, rotation_y(yaw))


@pytest.mark.parametrize("how", ["exact", "as-released"])
def test_rays_equal_the_releases_formulas(authors: Path, tmp_path: Path, how: str) -> None:
    """In float64 to 1e-12, in the store's float32 to 1e-6 of the distance."""
    store = import_files(authors, tmp_path / "store", camera_offset=how)
    for record in store.records():
        value = json.loads(record.extra)["record"]
        offset = released_formulas.offset(value) if how == "exact" else None
        origin, directions = released_formulas.canonical_rays(value, offset)
        patch = store.patch(record.patch_id)
        assert patch.box is not None
        pairs = [(double(store, record.patch_id), 1e-12), ((patch.camera, patch.box), 1e-6)]
        for (camera, box), tolerance in pairs:
            batch = Box3D(box.center[None], box.size[None], box.rotation[None])
            rays = to_canonical(image_rays(camera), batch)
            ours = rays.directions[0].reshape(directions.shape).numpy()
            np.testing.assert_allclose(ours, directions, atol=tolerance * np.abs(directions).max())
            np.testing.assert_allclose(rays.origins[0, 0].numpy(), origin, atol=tolerance * np.linalg.norm(origin))


@pytest.mark.parametrize(("depth_m", "pixels"), [(5.0, 8.6), (10.0, 4.3), (20.0, 2.2)])
def test_the_projections_translation_moves_a_box(tmp_path: Path, depth_m: float, pixels: float) -> None:
    value = make_record("km", "km_0000000000", 0) | {"w": 1242, "h": 375, "yaw": -1.57}
    value |= {"obj_x": 0.5, "obj_z": depth_m}
    value |= dict(zip(("xmin", "ymin", "xmax", "ymax"), released_formulas.envelope(value), strict=True))
    value["ymax"] = min(value["ymax"], 374.0)  # the nearest one reaches below the photograph
    root = write_subset(tmp_path, "km", [value])
    exact, released = (
        import_files(root, tmp_path / how, camera_offset=how).record("km-0000-000000-000")
        for how in ("exact", "as-released")
    )
    places = []
    for record in (exact, released):
        assert record.box_center is not None
        x, y, z = record.box_center
        places.append((record.fx * x / z, record.fy * y / z))
    # to the published tenth of a pixel; the box stands beside the axis, where the shift in z counts a little too
    assert math.dist(*places) == pytest.approx(pixels, abs=0.1)
    assert released.camera_offset == (0.0, 0.0, 0.0)
    assert exact.camera_offset == pytest.approx((0.0598, -0.0004, 0.0027), abs=6e-5)
    assert exact.box_iou is not None
    assert released.box_iou is not None
    assert exact.box_iou > released.box_iou + 0.005


def test_as_released_is_selectable_for_kitti_too(tmp_path: Path) -> None:
    row = " ".join(map(str, (721.5377, 0, 609.5593, 44.85728, 0, 721.5377, 172.854, 0.2163791, 0, 0, 1, 0.002745884)))
    exact = parse_calibration(f"P2: {row}", name="calib.txt")
    released = parse_calibration(f"P2: {row}", name="calib.txt", camera_offset="as-released")
    np.testing.assert_allclose(exact.camera_offset, released_formulas.offset(KITTI | KITTI_T), rtol=1e-12)
    assert released == replace(exact, camera_offset=(0.0, 0.0, 0.0))


def test_all_that_was_released_is_kept_and_split_as_released(tmp_path: Path) -> None:
    """The rule on the json's order, with patches that our own filters would reject."""
    records = []
    for index in range(37):
        value = make_record("km", f"km_{index % 3:02d}{index:05d}{index % 7:03d}", 0)
        value["obj_z"] = 20.0 + 2 * index
        value |= dict(zip(("xmin", "ymin", "xmax", "ymax"), released_formulas.envelope(value), strict=True))
        records.append(value)
    store = import_files(write_subset(tmp_path, "km", records), tmp_path / "store")
    ids = [identify("km", value["patch"], 0).patch_id for value in records]
    assert store.patch_ids() == ids
    num_train = math.ceil(0.9 * 37)
    train = {ids[i] for i in np.linspace(0, 36, num_train, dtype=int)}
    assert set(store.patch_ids(split="released-patch", part="train")) == train
    assert set(store.patch_ids(split="released-patch", part="test")) == set(ids) - train
    judge_store(store, FilterRecipe())
    write_splits(open_store(tmp_path / "store"))
    assert len(open_store(tmp_path / "store").patch_ids()) < 37


def test_root_may_be_a_file_its_folder_or_the_folder_above(authors: Path, tmp_path: Path) -> None:
    for number, root in enumerate((authors / "ko.json", authors, authors.parent)):
        changes = {} if root.suffix else {"subset": "ko"}
        found = import_files(root, tmp_path / str(number), **changes)
        assert {name[:2] for name in found.patch_ids()} == {"ko"}


def test_workers_and_an_interruption_change_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "ROWS_PER_GROUP", 8)  # shards of 128
    value = make_record("km", "km_0000000000", 0)
    records = [value | {"image_file": f"{index}.png"} for index in range(200)]  # of one patch file
    root = write_subset(tmp_path / "in", "km", records)

    def tree(path: Path) -> dict[str, bytes]:
        files = [file for file in sorted(path.rglob("*")) if file.is_file() and file.parent.name != "runs"]
        return {str(file.relative_to(path)): file.read_bytes() for file in files}

    def interrupt(description: str, done: int, total: int, note: str = "") -> None:
        if (description, done) == ("build", 180):
            raise KeyboardInterrupt

    whole = import_files(root, tmp_path / "whole")
    assert whole.patch_ids()[:3] == ["km-0000-000000-000", "km-0000-000000-000.2", "km-0000-000000-000.3"]
    assert whole.info()["instances"] == 1
    config = BuildConfig(source="legacy-json", root=root, out=tmp_path / "again", workers=1)
    with pytest.raises(KeyboardInterrupt):
        build(config, interrupt)
    assert len(open_store(tmp_path / "again")) == 128
    build(replace(config, workers=2))
    assert tree(tmp_path / "again") == tree(tmp_path / "whole")

    with pytest.raises(KeyboardInterrupt):
        build(replace(config, out=tmp_path / "other"), interrupt)
    text = root.read_text()
    root.write_text(text.replace("-1.57", "-1.56"))  # another json: nothing of the first may stay
    build(replace(config, out=tmp_path / "other"))
    assert set(open_store(tmp_path / "other").table(["box_yaw"])["box_yaw"].to_pylist()) == {-1.56}


NAMES = [
    ("km", "patch/km_0100097004_patch.png", "km-0001-000097-004", "km-0001-004"),
    ("km", "patch/deeper/km_0100097004_patch.png", "km-0001-000097-004", "km-0001-004"),
    ("ko", "patch/ko_000748012345_patch.png", "ko-007480-12345", "ko-007480-12345"),
    ("dv", "patch/dv_0000002123456_patch.png", "dv-000002-123456", "dv-123456"),
    ("ns", "patch/ns_1230004500067_patch.png", "ns-0123-000045-00067", "ns-0123-000045-00067"),
    ("km", "patch/ko_000748012345_patch.png", "km-at000003", "km-at000003"),  # another subset's grammar
    ("km", "patch/km_010009700_patch.png", "km-at000003", "km-at000003"),  # a digit is missing
    ("km", "patch/km_０100097004_patch.png", "km-at000003", "km-at000003"),  # a full-width digit
    ("dv", "patch/车.png", "dv-at000003", "dv-at000003"),
]


@pytest.mark.parametrize(("subset", "path", "patch_id", "instance_id"), NAMES)
def test_the_grammar_of_file_names(subset: str, path: str, patch_id: str, instance_id: str) -> None:
    identity = identify(subset, path, 3)
    assert (identity.patch_id, identity.instance_id) == (patch_id, instance_id)


def test_thresholds_are_for_refilter(authors: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="carstudio dataset refilter STORE"):
        import_files(authors, tmp_path / "s", filters=FilterRecipe(mask_ratio=0.7))
    assert not (tmp_path / "s").exists()
