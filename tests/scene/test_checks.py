"""Replay and simulation gap: figures against the metrics called by hand, and a detector whose answers are known."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.cli import run
from carstudio.errors import InputError
from carstudio.evaluation.metrics import psnr, psnr_mask
from carstudio.images import read_image
from carstudio.perception.onnx_detector import OnnxDetector
from carstudio.perception.results import Detection2D, Photo
from carstudio.scene.drawing import read_photo
from carstudio.scene.replay import read_instances, replay, replayed_scene
from carstudio.scene.scene_file import save_scene
from carstudio.scene.simulation_gap import GapFrame, TruthBox, match, measure, original_frames, simulation_gap
from scene.toy_log import toy_scene


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay")
    scene = toy_scene(folder, frames=2)
    return folder, scene, replay(scene, folder / "scene", folder / "out")


def test_replay_scores_are_the_metrics_of_the_written_pictures(replayed):
    folder, scene, scores = replayed
    tracks = {track.track_id: track for track in scores.tracks}
    assert sorted(tracks) == ["1", "2"]
    by_hand, whole = [], []
    for frame in scene.frames:
        truth = torch.from_numpy(read_photo(scene.root, frame) / 255)
        drawn = torch.from_numpy(read_image(folder / "out" / "rgb" / f"{frame.name}.png") / 255)
        mask = torch.from_numpy(read_instances(folder / "out" / "instance" / f"{frame.name}.png") == 1)
        by_hand.append(float(psnr_mask(drawn, truth, mask)))
        whole.append(float(psnr(drawn, truth)))
    assert tracks["1"].psnr_mask == pytest.approx(np.mean(by_hand), abs=1e-3)
    assert scores.psnr == pytest.approx(np.mean(whole), abs=1e-3)
    assert scores.psnr > tracks["1"].psnr_mask  # most of a frame is the photograph
    assert json.loads((folder / "out" / "replay.json").read_text())["frames"] == 2
    assert "| whole frames |" in (folder / "out" / "replay.md").read_text()


def test_a_scene_without_cars_has_no_replay(replayed):
    scene = replayed[1]
    with pytest.raises(InputError, match="no track of the scene has a car"):
        replayed_scene(scene.without_track("1").without_track("2"))


def test_matching_takes_the_surest_detection_and_each_truth_once():
    truth = [(0.0, 0.0, 10.0, 10.0), (20.0, 0.0, 30.0, 10.0)]
    boxes = [(21.0, 0.0, 31.0, 10.0), (0.0, 0.0, 10.0, 9.0), (1.0, 0.0, 10.0, 10.0), (100.0, 0.0, 110.0, 9.0)]
    assert match(truth, boxes) == [1, 0]
    assert match(truth, []) == [None, None]
    assert match([], boxes) == []
    assert match(truth, [(5.0, 0.0, 15.0, 10.0)]) == [None, None]  # an IoU of a third


class Known:
    """Answers with fixed boxes, whatever it is shown."""

    def __init__(self, found: list[Detection2D]) -> None:
        self.found = found

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        return [self.found for _ in photos]


def test_recall_and_confidence_are_counted():
    picture = np.zeros((40, 60, 3), np.uint8)
    truth = (TruthBox("1", (0.0, 0.0, 10.0, 10.0), False), TruthBox("2", (20.0, 0.0, 30.0, 10.0), True))
    found = [
        Detection2D((20.0, 0.0, 30.0, 10.0), "Car", 0.9),
        Detection2D((0.0, 0.0, 10.0, 10.0), "Pedestrian", 0.8),  # another class finds no vehicle
    ]
    row, scores = measure("x", [GapFrame(0, picture, truth), GapFrame(1, picture, truth[:1])], Known(found), total=2)
    assert scores == {(0, "1"): 0.0, (0, "2"): 0.9, (1, "1"): 0.0}
    assert (row.boxes, row.found, row.recall, row.confidence) == (3, 1, 0.3333, 0.9)
    assert (row.drawn_boxes, row.drawn_recall, row.drawn_confidence) == (1, 1.0, 0.9)
    empty, _ = measure("y", [], Known([]), total=0)
    assert (empty.recall, empty.confidence, empty.drawn_recall) == (None, None, None)


def test_the_gap_is_tabled(replayed, tmp_path):
    folder, scene, _ = replayed
    assert [len(frame.truth) for frame in original_frames(scene)] == [2, 2]
    found = [Detection2D((10.0, 10.0, 50.0, 50.0), "Car", 0.7)]
    rows = simulation_gap(scene, {"replay": folder / "out"}, Known(found), tmp_path)
    assert [row.name for row in rows] == ["photographs", "replay"]
    assert rows[0].found == 2  # the two labels share a box: one of them in each frame
    value = json.loads((tmp_path / "simulation_gap.json").read_text())
    assert value["same_objects"]["replay"]["boxes"] <= 4
    assert "| replay |" in (tmp_path / "simulation_gap.md").read_text()


def test_the_verb_replays_and_the_gap_needs_edited_folders(replayed, tmp_path, capsys):
    folder, scene, scores = replayed
    save_scene(folder / "scene", scene)
    assert run(["scene", "replay", str(folder / "scene"), "--out", str(tmp_path / "r"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["psnr"] == pytest.approx(scores.psnr, abs=1e-6)
    gap = ["scene", "gap", str(folder / "scene"), "--detector", "onnx:none.onnx", "--out", str(tmp_path / "g")]
    assert run([*gap, "--edited", str(tmp_path)]) == 2
    assert "expected an edited log" in capsys.readouterr().err


def test_the_real_detector_finds_photographed_cars(test_data: Path):
    from carstudio.scene.kitti import open_mot_log

    log = open_mot_log(test_data / "kitti-mot", "0001", frames="0-1")
    detector = OnnxDetector(test_data / "detector" / "yolox_nano.onnx")
    row, _ = measure("photographs", original_frames(log.scene), detector, total=2)
    assert row.boxes >= 6
    assert row.recall is not None
    assert row.recall > 0.7
