"""The build on a small made-up KITTI folder, and on the real frames where they are."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.dataset
import pytest
import torch

from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.inputs import digest_of_inputs
from carstudio.dataset.judging import judge_store
from carstudio.dataset.outlines import CORE_PARTS, core_hulls, crop_window, object_box, object_hull, occluder_hulls
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.plans import input_places, open_source, plan_frames
from carstudio.dataset.sources.frame import parse_frame_range
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.geometry.box3d import envelope
from carstudio.geometry.camera import Camera
from carstudio.geometry.overlap import box2d_iou
from carstudio.images import read_image
from dataset.made_up_kitti import HEIGHT, P2, WIDTH, made_up_kitti


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three frames of sequence 0000: two cars (one hides the other), a van, DontCare; frame 2 is broken."""
    return made_up_kitti(tmp_path / "kitti")


def build_small(root: Path, out: Path, **changes: object) -> PatchStore:
    config = BuildConfig(source="kitti-mot", root=root, out=out, workers=1)
    build(replace(config, **changes))  # type: ignore[arg-type]
    return open_store(out)


def test_summary_counts_candidates_reasons_and_problems(root: Path, tmp_path: Path) -> None:
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert summary.candidates == sum(summary.reasons.values()) == 3
    assert summary.kept == summary.reasons.get("kept", 0)
    assert len(summary.problems) == 1
    assert summary.problems[0].startswith("frame 000002 skipped: label_02/0000.txt line 6: expected 15 columns")
    assert pyarrow.dataset.dataset(tmp_path / "s" / "data").count_rows() == 3
    store = open_store(tmp_path / "s")
    assert store.verify() == []
    assert store.split_names() == ["instance", "released-patch", "view"]
    assert store.info()["reasons"] == summary.reasons


def test_records_say_what_the_files_say(root: Path, tmp_path: Path) -> None:
    store = build_small(root, tmp_path / "s")
    assert store.patch_ids(kept=False) == ["km-0000-000000-007", "km-0000-000000-008", "km-0000-000001-007"]
    record = store.record("km-0000-000001-007")
    assert (record.instance_id, record.sequence_id, record.frame_index) == ("km-0000-007", "0000", 1)
    assert (record.frame_id, record.frame_path) == ("0000-000001", "image_02/0000/000001.png")
    assert (record.fx, record.fy, record.cx, record.cy) == (200.0, 200.0, 120.0, 60.0)
    assert (record.frame_width, record.frame_height, record.camera_source) == (WIDTH, HEIGHT, "calib:P2")
    assert (record.truncation, record.occlusion, record.score_2d, record.licence) == (
        0.0,
        0,
        None,
        "CC-BY-NC-SA-3.0 (KITTI)",
    )
    assert record.box_center == pytest.approx((0.1 + 8.88 / 200, 0.25 - 0.01 / 200, 5.001), abs=1e-9)
    assert (record.box_size, record.box_yaw) == ((4.0, 1.5, 1.8), -1.2)
    assert record.box_iou == pytest.approx(1.0, abs=1e-3)
    assert json.loads(record.extra)["label"].startswith("Car 0 0 -1.2")
    frame = read_image(root / "training" / "image_02" / "0000" / "000001.png")
    x0, y0, x1, y1 = map(int, record.box2d)
    np.testing.assert_array_equal(store.patch(record.patch_id).image, frame[y0 : y1 + 1, x0 : x1 + 1])
    ratio = (store.patch(record.patch_id).mask == MaskValue.CAR).mean()
    assert record.mask_ratio == pytest.approx(ratio)


def test_a_nearer_object_makes_pixels_unknown(root: Path, tmp_path: Path) -> None:
    store = build_small(root, tmp_path / "s")
    near, far = (store.patch(f"km-0000-000000-00{track}").mask for track in (7, 8))
    assert not (near == MaskValue.UNKNOWN).any()
    assert (far == MaskValue.UNKNOWN).any()
    alone = build_small(root, tmp_path / "t", frames="1-1").patch("km-0000-000001-007").mask
    assert not (alone == MaskValue.UNKNOWN).any()


def tree(path: Path) -> dict[str, bytes]:
    files = [file for file in sorted(path.rglob("*")) if file.is_file()]
    return {str(file.relative_to(path)): file.read_bytes() for file in files if file.parent.name != "runs"}


def test_number_of_processes_changes_no_byte(root: Path, tmp_path: Path) -> None:
    folder = root / "training" / "image_02" / "0000"
    for frame in range(3, 17):  # a second process starts from 16 frames on
        shutil.copy(folder / "000000.png", folder / f"{frame:06d}.png")
    build_small(root, tmp_path / "one")
    build_small(root, tmp_path / "two", workers=2)
    assert tree(tmp_path / "one") == tree(tmp_path / "two")
    runs = list((tmp_path / "one" / "runs").iterdir())
    assert [path.name for path in runs] == ["0001.json"]
    assert json.loads(runs[0].read_text())["config"]["segmenter"] == "grabcut"


def test_an_interrupted_build_goes_on_to_the_same_bytes(root: Path, tmp_path: Path) -> None:
    def interrupt(description: str, done: int, total: int, note: str = "") -> None:
        if done == 1:
            raise KeyboardInterrupt

    config = BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1)
    with pytest.raises(KeyboardInterrupt):
        build(config, interrupt)
    assert not open_store(tmp_path / "s").manifest.is_finished
    build(config)
    build_small(root, tmp_path / "whole")
    assert tree(tmp_path / "s") == tree(tmp_path / "whole")


def test_a_finished_build_started_again_is_done_and_with_other_settings_refused(root: Path, tmp_path: Path) -> None:
    """A job killed between its last write and its end is started again by its batch system."""
    config = BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1)
    first = build(config)
    before = {path: path.read_bytes() for path in (tmp_path / "s").rglob("*") if path.is_file()}
    (tmp_path / "s" / ".lock").touch()
    again = build(replace(config, workers=2))
    assert replace(again, seconds=0.0) == replace(first, problems=(), seconds=0.0)
    assert before == {path: path.read_bytes() for path in (tmp_path / "s").rglob("*") if path.is_file()}
    for changes in ({"filters": FilterRecipe(depth_m=5.0)}, {"frames": "0-1"}):
        with pytest.raises(InputError, match="already holds a finished store"):
            build(replace(config, **changes))  # type: ignore[arg-type]
    shutil.rmtree(tmp_path / "s" / "runs")
    with pytest.raises(InputError, match="already holds a finished store"):
        build(config)


@pytest.mark.parametrize("step", ["judge_store", "write_splits"])
def test_finished_is_said_last(root: Path, tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def die(*arguments: object) -> None:
        raise KeyboardInterrupt

    config = BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1)
    with monkeypatch.context() as patched:
        patched.setattr(f"carstudio.dataset.build.{step}", die)
        with pytest.raises(KeyboardInterrupt):
            build(config)
    assert not open_store(tmp_path / "s").manifest.is_finished
    build(config)
    build_small(root, tmp_path / "whole")
    assert tree(tmp_path / "s") == tree(tmp_path / "whole")


def test_refilter_looks_only_at_stored_values(root: Path, tmp_path: Path) -> None:
    store = build_small(root, tmp_path / "s")
    judge_store(store, FilterRecipe(depth_m=5.5, height_px=1.0, width_px=1.0, mask_ratio=0.0, box_iou=0.0))
    assert [verdict.reason for verdict in store.verdicts()] == ["depth_m", "depth_m", "kept"]
    assert open_store(tmp_path / "s").patch_ids() == ["km-0000-000001-007"]


def test_broken_frames_never_stop_a_build(root: Path, tmp_path: Path) -> None:
    images = root / "training" / "image_02" / "0000"
    (images / "000000.png").write_bytes((images / "000000.png").read_bytes()[:300])
    (images / "000001.png").write_bytes(b"")
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert (summary.candidates, summary.kept, len(summary.problems)) == (0, 0, 3)
    assert "image is broken or truncated" in summary.problems[0]
    assert "empty file" in summary.problems[1]


BAD_CONFIGS = [
    ({"frames": "5-9"}, "no numbered images within --frames 5-9"),
    ({"frames": "9-5"}, "A not above B"),
    ({"frames": "x"}, "expected A-B with whole numbers"),
    ({"sequence": "0042"}, "no sequence '0042'; there are ['0000']"),
    ({"source": "kitti-det"}, "no folder image_2/ or training/image_2/"),
    ({"segmenter": "magic"}, "expected one of grabcut, sam"),
    ({"workers": -1}, "--workers must be 0 (one per core) or more, found -1"),
]


@pytest.mark.parametrize(("changes", "message"), BAD_CONFIGS)
def test_bad_settings_are_explained_and_leave_nothing(
    root: Path, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        build_small(root, tmp_path / "s", **changes)
    assert message in str(caught.value)
    assert not (tmp_path / "s").exists()


def test_sequences_without_the_frames_asked_for_are_left_out(root: Path) -> None:
    training = root / "training"
    shutil.copytree(training / "image_02" / "0000", training / "image_02" / "0001")
    for name in ("label_02", "calib"):
        shutil.copy(training / name / "0000.txt", training / name / "0001.txt")
    shutil.copy(training / "image_02" / "0000" / "000000.png", training / "image_02" / "0001" / "000009.png")
    source = open_source(BuildConfig(source="kitti-mot", root=root, out=root, frames="5-20"))
    assert [(ref.sequence_id, ref.index) for ref in source.frames()] == [("0001", 9)]


def test_sequence_is_refused_for_kitti_det(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--sequence is for kitti-mot"):
        open_source(BuildConfig(source="kitti-det", root=root, out=tmp_path, sequence="0000"))


def test_frame_ranges() -> None:
    assert parse_frame_range(None) is None
    assert parse_frame_range("0-24") == (0, 24)
    assert parse_frame_range("7") == (7, 7)
    for text in ("", "-3", "3-", "a-b", "1-2-3"):
        with pytest.raises(InputError, match="expected A-B"):
            parse_frame_range(text)


def test_crop_window_is_the_released_slice() -> None:
    frame = np.arange(375 * 1242).reshape(375, 1242)
    rng = np.random.default_rng(1)
    for _ in range(200):
        xmin, xmax = np.sort(rng.uniform(0, 1241, 2))
        ymin, ymax = np.sort(rng.uniform(0, 374, 2))
        window = crop_window((xmin, ymin, xmax, ymax), 1242, 375)
        released = frame[int(ymin) : int(ymax) + 1, int(xmin) : int(xmax) + 1]
        np.testing.assert_array_equal(frame[window.slices], released)
    assert crop_window((-5.0, -5.0, 2000.0, 2000.0), 1242, 375).slices == (slice(0, 375), slice(0, 1242))
    with pytest.raises(InputError, match="lies outside the photograph"):
        crop_window((1300.0, 10.0, 1400.0, 60.0), 1242, 375)


def test_core_parts_lie_inside_the_outline(root: Path) -> None:
    source = open_source(BuildConfig(source="kitti-mot", root=root, out=root))
    frame = source.load(source.frames()[0])
    camera = Camera(torch.tensor(frame.intrinsics, dtype=torch.float64), WIDTH, HEIGHT)
    thing = frame.objects[0]
    box = object_box(thing)
    hull = object_hull(thing, camera)
    assert box is not None
    assert hull is not None
    for part, core in zip(CORE_PARTS, core_hulls(thing, camera), strict=True):
        corners = torch.cartesian_prod(*torch.tensor(part, dtype=torch.float64))  # by the plain formula
        points = camera.project((corners * box.size / 2) @ box.rotation.mT + box.center).numpy()
        np.testing.assert_allclose(core.min(axis=0), points.min(axis=0))
        np.testing.assert_allclose(core.max(axis=0), points.max(axis=0))
        assert (core.min(axis=0) >= hull.min(axis=0)).all()
        assert (core.max(axis=0) <= hull.max(axis=0)).all()
    assert len(occluder_hulls(frame.objects[1], frame, camera)) == 1
    assert occluder_hulls(thing, frame, camera) == ()


@pytest.mark.parametrize(
    ("kind", "folder", "least"), [("kitti-det", "kitti-obj", 0.956), ("kitti-mot", "kitti-mot", 0.93)]
)
def test_real_labels_agree_with_their_projection(test_data: Path, kind: str, folder: str, least: float) -> None:
    """Envelope IoU of whole cars: 0.9566 at worst in the detection frames, 0.939 in the tracking sequence."""
    source = open_source(BuildConfig(source=kind, root=test_data / folder, out=test_data))  # type: ignore[arg-type]
    with_offset, without = [], []
    for ref in source.frames():
        frame = source.load(ref)
        camera = Camera(torch.tensor(frame.intrinsics, dtype=torch.float64), 1242, 375)
        for thing in frame.objects:
            box = object_box(thing)
            if thing.type != "Car" or thing.truncation != 0 or box is None:
                continue
            label = torch.tensor(thing.box2d, dtype=torch.float64)
            shifted = replace(box, center=box.center - torch.tensor(frame.camera_offset, dtype=torch.float64))
            for boxes, ious in ((box, with_offset), (shifted, without)):
                outline = envelope(boxes, camera)
                assert outline is not None
                ious.append(float(box2d_iou(outline, label)))
    assert min(with_offset) >= least
    assert np.mean(with_offset) > 0.97
    assert np.mean(without) < np.mean(with_offset) - 0.02  # what dropping P2's translation costs


def test_real_frames_hold_the_known_tracks(test_data: Path, tmp_path: Path) -> None:
    """The data's README: sequence 0001 has 234 car boxes; large views are of tracks 0 to 3, then 4 and 5."""
    segmenter = f"onnx:{test_data / 'segmenter' / 'espnetv2_voc.onnx'}"
    pytest.importorskip("onnxruntime")
    config = BuildConfig(source="kitti-mot", root=test_data / "kitti-mot", out=tmp_path / "s", segmenter=segmenter)
    summary = build(replace(config, sequence="0001", workers=2))
    store = open_store(tmp_path / "s")
    assert summary.candidates == len(store) == 234
    assert summary.problems == ()
    rows = store.table(["patch_id", "instance_id", "frame_index"]).to_pylist()
    kept = set(store.patch_ids())
    early = {row["instance_id"] for row in rows if row["patch_id"] in kept and row["frame_index"] <= 24}
    late = {row["instance_id"] for row in rows if row["patch_id"] in kept and row["frame_index"] > 24}
    assert early == {f"km-0001-00{track}" for track in range(4)}
    assert late == {"km-0001-004", "km-0001-005"}
    assert summary.kept >= 30
    assert store.verify() == []


def test_the_same_command_on_changed_inputs_is_not_done(tmp_path: Path) -> None:
    """Done when nothing has changed; refused when a label or a photograph has, even by a digit."""
    root = made_up_kitti(tmp_path / "kitti")
    config = BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1)
    first = build(config)
    assert build(config).candidates == first.candidates
    label = root / "training" / "label_02" / "0000.txt"
    text = label.read_text()
    label.write_text(text.replace("1.5 1.8 4.0", "1.5 1.8 4.1", 1))
    with pytest.raises(InputError, match="finished"):
        build(config)
    label.write_text(text)
    build(config)
    (root / "training" / "image_02" / "0000" / "000009.png").write_bytes(b"")
    with pytest.raises(InputError, match="finished"):
        build(config)


def test_an_interrupted_build_does_not_go_on_with_other_inputs(tmp_path: Path) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    config = BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1)
    keys = [plan_frames(config, digest_of_inputs(input_places(config))).resume_key for _ in range(2)]
    assert keys[0] == keys[1]
    (root / "training" / "calib" / "0000.txt").write_text(P2.replace("200", "201"))
    assert plan_frames(config, digest_of_inputs(input_places(config))).resume_key != keys[0]
