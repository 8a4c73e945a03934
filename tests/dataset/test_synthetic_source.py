"""`synthesize`: a sound store, equal bytes whatever the number of processes, exact labels, plain messages."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.sources.synthetic import SynthConfig, car_records, patch_ids, synthesize
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.geometry.box3d import envelope
from carstudio.geometry.orbit import viewing_angles
from carstudio.geometry.overlap import box2d_iou


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    out = tmp_path_factory.mktemp("synth") / "store"
    summary = synthesize(SynthConfig(out=out, cars=3, views=3, size=64, workers=1))
    assert (summary.candidates, summary.kept, summary.instances) == (9, 9, 3)
    return open_store(out)


def test_the_store_is_sound_and_split(store: PatchStore) -> None:
    assert store.verify() == []
    assert store.split_names() == ["instance", "released-patch", "view"]
    assert set(store.split("view").values()) == {"train", "test"}
    assert len(store.verdicts()) == 9


def test_crops_masks_depth_and_boxes_agree(store: PatchStore) -> None:
    for patch_id in store.patch_ids():
        record, patch = store.record(patch_id), store.patch(patch_id)
        height, width = patch.mask.shape
        assert (width, height) == (record.crop_width, record.crop_height)
        assert set(np.unique(patch.mask)) <= {MaskValue.BACKGROUND, MaskValue.CAR}
        is_car = patch.mask == MaskValue.CAR
        assert patch.depth_m is not None
        assert np.array_equal(is_car, np.isfinite(patch.depth_m))
        assert is_car[0].any()
        assert is_car[:, 0].any()
        assert record.mask_ratio == pytest.approx(is_car.mean())
        assert patch.box is not None
        rows, columns = np.nonzero(is_car)
        positions = torch.tensor(np.stack([columns + 0.5, rows + 0.5], -1), dtype=torch.float32)
        points = patch.camera.unproject(positions, torch.tensor(patch.depth_m[is_car]))
        local = (points - patch.box.center) @ patch.box.rotation
        assert bool((local.abs() <= patch.box.size / 2 + 0.01).all())  # depth is stored in steps of 1/256 m
        outline = envelope(patch.box, record.frame_camera)
        assert outline is not None
        assert record.box_iou == pytest.approx(float(box2d_iou(outline, torch.tensor(record.box2d))), abs=1e-4)


def test_upright_boxes_have_no_quaternion_and_the_yaw_always(store: PatchStore) -> None:
    for patch_id in store.patch_ids():
        record = store.record(patch_id)
        assert (record.box_rotation is None) == (json.loads(record.extra)["camera"] == "kitti")
        box = record.box
        assert box is not None
        assert float(box.yaw_rad) == pytest.approx(record.box_yaw, abs=1e-5)


def test_processes_change_no_byte_and_a_car_stands_alone(store: PatchStore, tmp_path: Path) -> None:
    config = SynthConfig(out=tmp_path / "store", cars=8, views=2, size=32, workers=2)
    synthesize(config)
    two = open_store(config.out)
    alone = car_records(config, [], 5)
    assert [two.record(name) for name in patch_ids(config, 5)] == list(alone)


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    whole = SynthConfig(out=tmp_path / "whole", cars=3, views=2, size=32, workers=1)
    synthesize(whole)
    config = SynthConfig(out=tmp_path / "cut", cars=3, views=2, size=32, workers=1)

    def stop(description: str, done: int, total: int, note: str = "") -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesize(config, stop)
    synthesize(config)
    assert open_store(config.out).data_sha256 == open_store(whole.out).data_sha256


def test_meshes_go_the_same_way(test_data: Path, tmp_path: Path) -> None:
    config = SynthConfig(out=tmp_path / "m", cars=3, views=1, size=48, workers=1, meshes=test_data / "meshes")
    synthesize(config)
    store = open_store(config.out)
    styles = [json.loads(store.record(name).extra)["style"] for name in store.patch_ids()]
    assert styles == ["hatchback", "hatchback_red", "suv"]
    assert store.record(store.patch_ids()[0]).licence == "unknown"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cars": 0}, "--cars must be 1 or more"),
        ({"size": 8}, "--size must be 16 to 4096"),
        ({"meshes": Path("nowhere")}, "found none"),
    ],
)
def test_wrong_settings_are_told(tmp_path: Path, settings: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        synthesize(SynthConfig(out=tmp_path / "s", **settings))


def test_tracks_are_drives_and_true_turned_views_of_other_sides(tmp_path: Path) -> None:
    out = tmp_path / "tracks"
    config = SynthConfig(out=out, cars=3, views=4, size=48, seed=5, tracks=True, workers=1)
    assert synthesize(config).candidates == 3 * (4 + 18)
    store = open_store(out)
    assert store.verify() == []
    train, test = (set(store.patch_ids(split="yaw", part=part)) for part in ("train", "test"))
    for index in range(3):
        records = [store.record(name) for name in patch_ids(config, index)]
        frames, turned = records[:4], records[4:]
        assert {record.instance_id for record in records} == {f"syn-5-{index:06d}"}
        assert [record.frame_index for record in frames] == [0, 1, 2, 3]
        assert {record.sequence_id for record in frames} == {f"syn-5-{index:06d}"}
        assert {(record.frame_index, record.sequence_id) for record in turned} == {(None, None)}
        assert {record.box_center for record in turned} == {frames[2].box_center}
        assert {record.patch_id for record in frames} <= train
        seen, unseen = (
            np.exp(1j * np.array([float(viewing_angles(r.box)[0]) for r in part if r.patch_id in side and r.box]))
            for part, side in ((frames, train), (turned, test))
        )
        assert len(unseen) >= 16
        middle = seen.mean() / abs(seen.mean())
        ends = np.angle(seen / middle).min(), np.angle(seen / middle).max()
        beside = np.angle(unseen / middle)
        assert ((beside < ends[0]) | (beside > ends[1])).all()
    with pytest.raises(InputError, match="leave --cameras phone out"):
        synthesize(SynthConfig(out=tmp_path / "phone", cars=1, tracks=True, cameras="phone"))
