"""Scenes from KITTI folders: poses against oracles, what is missing, cars of tracks, and going on after a stop."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import carstudio.scene.lifting
from carstudio.cli import run
from carstudio.dataset.pixels import PreparedPatch, prepare_patch
from carstudio.errors import InputError
from carstudio.fitting.car_file import load_car
from carstudio.fitting.optimise import FitConfig
from carstudio.geometry.orbit import viewing_angles
from carstudio.perception.grabcut import GrabCutSegmenter
from carstudio.perception.results import MaskResult, SegmentRequest
from carstudio.scene.kitti import Log, open_det_log, open_mot_log
from carstudio.scene.lifting import LiftConfig, lift_tracks, mirrored_views, unseen_sides
from carstudio.scene.poses import lidar_and_imu, read_odometry_poses, read_oxts_poses
from carstudio.scene.scene_file import load_scene
from carstudio.scene.views import ViewConfig, rank_views
from carstudio.training.checkpoint import load_model
from dataset.made_up_kitti import P2, made_up_kitti
from scene.made_up_scene import made_up_car
from training.toy import toy_record

QUICK = LiftConfig(fit=FitConfig(steps=1), rays=16, views=ViewConfig(views=2, mask_ratio=-1.0))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Frames 0, 1 and 3 to 5 are whole, 2 has a broken label; cars 7 and 8, van 9."""
    return made_up_kitti(tmp_path / "kitti", more_frames=3)


def odometry(count: int) -> str:
    lines = []
    for index in range(count):
        c, s = math.cos(0.1 * index), math.sin(0.1 * index)
        lines.append(f"{c} 0 {s} {index} 0 1 0 0 {-s} 0 {c} {2 * index}")
    return "\n".join(lines) + "\n"


def test_a_broken_frame_costs_only_itself(root: Path) -> None:
    log = open_mot_log(root, "0000")
    assert [frame.index for frame in log.scene.frames] == [0, 1, 3, 4, 5]
    assert any("000002 left out" in problem for problem in log.problems)
    assert set(log.scene.tracks) == {"7", "8", "9"}
    assert sorted(log.scene.tracks["7"].boxes) == [0, 1, 3, 4, 5]
    assert log.scene.tracks["9"].type == "Van"
    assert log.scene.frames[0].width == 240
    assert log.scene.frames[0].world_from_camera is None


def test_labels_without_photographs_are_told(root: Path) -> None:
    (root / "training/image_02/0000/000004.png").unlink()
    log = open_mot_log(root, "0000")
    assert [frame.index for frame in log.scene.frames] == [0, 1, 3, 5]
    assert any("labels without a photograph: frames 4" in problem for problem in log.problems)


def test_poses_place_the_photographs_camera(root: Path) -> None:
    """X_camera = X_label + offset, so the camera lies at -offset in the label frame that the file places."""
    (root / "training/poses").mkdir()
    (root / "training/poses/0000.txt").write_text(odometry(4))
    log = open_mot_log(root, "0000")
    frame = log.scene.frame(3)
    pose, offset = np.array(frame.world_from_camera), np.array(frame.camera_offset)
    file = np.array(odometry(4).splitlines()[3].split(), float).reshape(3, 4)
    point_in_label = np.array([1.0, 2.0, 3.0])
    world = file[:, :3] @ point_in_label + file[:, 3]
    assert np.allclose(pose[:3, :3] @ (point_in_label + offset) + pose[:3, 3], world)
    assert log.scene.frame(5).world_from_camera is None
    assert any("2 frames have no pose" in problem for problem in log.problems)


@pytest.mark.parametrize("text", ["1 2 3\n", "x " * 12 + "\n", "2 0 0 0 0 1 0 0 0 0 1 0\n", "nan " * 12])
def test_broken_poses_are_told_and_left_out(root: Path, text: str) -> None:
    (root / "training/poses").mkdir()
    (root / "training/poses/0000.txt").write_text(text)
    log = open_mot_log(root, "0000")
    assert all(frame.world_from_camera is None for frame in log.scene.frames)
    assert any("no poses:" in problem and "line 1" in problem for problem in log.problems)
    with pytest.raises(InputError, match="line 1"):
        read_odometry_poses(root / "training/poses/0000.txt", (0.0, 0.0, 0.0))


CALIB = (
    P2
    + "\nR_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
    + "Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8\n"
)


def test_oxts_says_where_the_car_went(root: Path) -> None:
    """North by 0.00001 degrees a frame (1.113 m), heading north, then turning left: an oracle in plain numbers."""
    lines = [f"{49 + 1e-5 * i} 8.4 110 0 0 {math.pi / 2 + 0.05 * i} 0 0 0" for i in range(6)]
    (root / "training/oxts").mkdir()
    (root / "training/oxts/0000.txt").write_text("\n".join(lines))
    (root / "training/calib/0000.txt").write_text(CALIB)
    log = open_mot_log(root, "0000")
    first, last = (np.array(log.scene.frame(index).world_from_camera) for index in (0, 5))
    assert np.allclose(first, np.eye(4), atol=1e-6)
    step = 5 * 1e-5 * math.pi / 180 * 6378137.0
    assert abs(last[2, 3] - step) < 0.3  # the lever arm from IMU to camera turns with the car
    assert math.isclose(last[0, 2], -math.sin(0.25), abs_tol=1e-6)  # it looks to the left of where it looked
    known = lidar_and_imu(CALIB, (0.0, 0.0, 0.0), name="calib")
    poses = read_oxts_poses(root / "training/oxts/0000.txt", known["camera_from_imu"])
    imu = [np.array(poses[i]) @ known["camera_from_imu"] for i in (0, 5)]
    assert math.isclose(float(np.linalg.norm(imu[1][:3, 3] - imu[0][:3, 3])), step, rel_tol=1e-6)


def test_lidar_lands_in_front_of_the_camera(root: Path) -> None:
    (root / "training/velodyne/0000").mkdir(parents=True)
    (root / "training/velodyne/0000/000001.bin").write_bytes(np.array([10, 1, -1.7, 0.5], np.float32).tobytes())
    (root / "training/calib/0000.txt").write_text(CALIB)
    frames = open_mot_log(root, "0000").scene.frames
    assert [frame.lidar is not None for frame in frames] == [False, True, False, False, False]
    point = np.array(frames[1].camera_from_lidar) @ [10, 1, -1.7, 1]
    assert np.allclose(point[:3] - np.array(frames[1].camera_offset), [-1, 1.62, 9.73])


def lift(log: Log, folder: Path, config: LiftConfig = QUICK):  # type: ignore[no-untyped-def]
    return lift_tracks(log, folder, GrabCutSegmenter(), config, segmenter_name="grabcut")


def test_tracks_become_cars_and_finished_ones_are_kept(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_mot_log(root, "0000")
    lifted = lift(log, tmp_path / "scene")
    assert lifted.scene.tracks["7"].car is not None
    car = load_car(tmp_path / "scene/cars/track-7")
    assert car.size == (4.0, 1.5, 1.8)
    assert car.instance_id == "km-0000-007"
    assert 1 <= len(car.provenance["patches"]) <= 2
    before = (tmp_path / "scene/cars/track-7/car.json").read_bytes()

    def never(*args: object, **kwargs: object) -> None:
        raise AssertionError("fitted again")

    with monkeypatch.context() as patched:
        patched.setattr(carstudio.scene.lifting, "fit_patches", never)
        again = lift(log, tmp_path / "scene")
    assert again.scene == lifted.scene
    (tmp_path / "scene/cars/track-7/car.safetensors").write_bytes(b"damaged")
    assert lift(log, tmp_path / "scene").scene == lifted.scene  # made anew, to the same bytes
    assert (tmp_path / "scene/cars/track-7/car.json").read_bytes() == before
    other = lift(log, tmp_path / "scene", replace(QUICK, seed=1))
    assert other.scene.tracks["7"].car != lifted.scene.tracks["7"].car


class BrokenFor8:
    """A segmenter that fails in a way nobody foresaw on one car."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        if request.patch_id.endswith("008"):
            raise RuntimeError("no kernel image is available")
        return GrabCutSegmenter().segment(request)


def test_one_bad_track_costs_only_itself(root: Path, tmp_path: Path) -> None:
    log = open_mot_log(root, "0000")
    lifted = lift_tracks(log, tmp_path / "scene", BrokenFor8(), QUICK, segmenter_name="broken")
    assert lifted.scene.tracks["8"].car is None
    assert lifted.scene.tracks["7"].car is not None
    assert any("track 8 has no car: RuntimeError: no kernel" in problem for problem in lifted.problems)


def test_cars_that_cannot_be_seen_have_no_views(root: Path) -> None:
    log = open_mot_log(root, "0000")
    track = log.scene.tracks["7"]
    near = rank_views(log.scene, track, ViewConfig())
    assert near
    assert near[0].quality == max(view.quality for view in near)
    box = track.boxes[0]
    for x, z in ((0.0, -6.0), (60.0, 6.0), (0.0, 80.0), (0.0, 49.0)):  # behind, beside, far, too small
        away = replace(track, boxes={0: replace(box, center=(x, box.center[1], z))})
        assert rank_views(log.scene, away, ViewConfig()) == []
    cut = replace(track, boxes={0: box, 1: replace(box, center=(3.6, box.center[1], box.center[2]))})
    ranked = rank_views(log.scene, cut, ViewConfig())
    assert [view.frame for view in ranked] == [0, 1]  # cut by the border: seen, but less


def test_views_from_another_side_come_before_more_of_the_same(root: Path) -> None:
    log = open_mot_log(root, "0000")
    track = log.scene.tracks["7"]
    box = track.boxes[0]
    turned = replace(box, rotation=(1.0, 0.0, 0.0, 0.0), center=(0.0, box.center[1], 8.0))
    boxes = {0: box, 1: replace(box, center=(0.0, box.center[1], 6.1)), 3: turned}
    ranked = rank_views(log.scene, replace(track, boxes=boxes), ViewConfig())
    assert [view.frame for view in ranked] == [0, 3, 1]


def test_flipped_photographs_show_only_sides_that_none_shows() -> None:
    def patch(azimuth_deg: float) -> PreparedPatch:
        return replace(prepare_patch(toy_record(0, 0, azimuth_deg).decode(), 32), patch_id=str(azimuth_deg))

    def side(patch: PreparedPatch) -> float:
        return math.degrees(float(viewing_angles(patch.box)[0]))

    found = mirrored_views([patch(60.0), patch(120.0)])
    assert [round(side(each)) for each in found] == [-60, -120]
    assert torch.equal(found[0].rgb, patch(60.0).rgb.flip(1))
    assert mirrored_views([patch(180.0), patch(5.0)]) == []  # from behind and before both sides look alike
    assert [round(side(each)) for each in mirrored_views([patch(60.0), patch(-50.0), patch(110.0)])] == [-110]


def test_pictures_of_its_own_stand_in_for_sides_that_nothing_shows() -> None:
    model, car = load_model("car-gaussians"), made_up_car(1)
    seen = [prepare_patch(toy_record(0, 0, azimuth).decode(), 32) for azimuth in (0.0, 100.0)]
    found = unseen_sides(model, car, seen)
    sides = [round(math.degrees(float(viewing_angles(patch.box)[0]))) % 360 for patch in found]
    assert sides == [180, 225, 270]  # 45 and 135 are within 50 degrees of what is seen, 315 of 0
    assert all(patch.box.size.tolist() == pytest.approx(car.size) for patch in found)
    assert all(50 < int((patch.mask == 255).sum()) for patch in found)


def test_the_verb_makes_a_scene_and_says_what_is_in_it(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    options = ["--sequence", "0000", "--steps", "1", "--mask-ratio", "0", "--device", "cpu", "--json"]
    assert run(["scene", "from-kitti-mot", "--root", str(root), "--out", str(out), "--frames", "0-1", *options]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["frames"] == 2
    assert value["tracks"]["7"]["car"] == "track-7"
    assert load_scene(out).tracks["7"].car is not None
    assert run(["scene", "info", str(out)]) == 0
    assert "7  Car" in capsys.readouterr().out
    assert run(["scene", "from-kitti-mot", "--root", str(root), "--out", str(out), "--sequence", "0009"]) == 2
    assert "no sequence '0009'" in capsys.readouterr().err


def test_an_empty_label_file_is_an_empty_scene(root: Path, tmp_path: Path) -> None:
    (root / "training/label_02/0000.txt").write_text("")
    out = tmp_path / "scene"
    command = ["scene", "from-kitti-mot", "--root", str(root), "--sequence", "0000", "--out", str(out), "--quiet"]
    assert run([*command, "--device", "cpu"]) == 0
    assert load_scene(out).tracks == {}
    assert len(load_scene(out).frames) == 6


def test_detection_photographs_are_a_scene_without_a_path(test_data: Path, tmp_path: Path) -> None:
    log = open_det_log(test_data / "kitti-obj", frames="8-10")
    assert [frame.name for frame in log.scene.frames] == ["000008", "000009", "000010"]
    assert all(frame.world_from_camera is None for frame in log.scene.frames)
    cars = [name for name, track in log.scene.tracks.items() if track.type == "Car" and 8 in track.boxes]
    assert len(cars) == 6
    assert all(len(track.boxes) == 1 for track in log.scene.tracks.values())


def test_parked_cars_of_a_real_log_stand_still_in_its_world(test_data: Path) -> None:
    """Poses, boxes and offset agree: labels and poses are independent, and parked cars move by decimetres only."""
    scene = open_mot_log(test_data / "kitti-mot", "0001", frames="0-24").scene
    for name in ("1", "2", "4", "5", "6"):
        places = [
            (np.array(scene.frame(index).world_from_camera) @ [*box.center, 1])[:3]
            for index, box in scene.tracks[name].boxes.items()
        ]
        assert len(places) > 10
        assert np.std(places, axis=0).max() < 0.4
