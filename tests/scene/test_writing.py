"""The written log: the contract's files, what others read of it, and going on after a stop."""

import json
from dataclasses import replace

import numpy as np
import pytest

from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.errors import InputError
from carstudio.images import read_image
from carstudio.scene import writing
from carstudio.scene.drawing import read_photo, render_frame
from carstudio.scene.replay import read_instances
from carstudio.scene.writing import PICTURES, foreign_tracks, write_edited
from scene.toy_log import STEP_M, inserted, placed, toy_scene

INSERTED = {0: placed(0.0, 9.0), 1: placed(0.0, 8.2)}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("written")
    scene = toy_scene(folder)
    edited = inserted(scene, "new-1", INSERTED).without_track("2")
    reports = []
    summary = write_edited(scene, edited, folder / "scene", folder / "out", report=lambda *a: reports.append(a))
    return folder, scene, edited, summary, reports


def test_every_file_of_the_contract_is_there(written):
    folder, _, _, summary, reports = written
    out = folder / "out"
    for name in ("000000", "000001", "000002"):
        assert all((out / kind / f"{name}.png").is_file() for kind in PICTURES)
        assert (out / "label_2" / f"{name}.txt").is_file()
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest == summary.manifest
    assert manifest["instances"] == {"1": 1, "2": 2, "new-1": 3}
    assert manifest["drawn_tracks"] == ["new-1"]
    assert manifest["removed_tracks"] == ["2"]
    assert (out / "video.mp4").stat().st_size > 1000
    assert "video.mp4" in (out / "index.html").read_text()
    assert [r for r in reports if r[0] == "drawing frames"][-1][1:3] == (3, 3)


def test_pictures_are_what_is_drawn(written):
    folder, scene, edited, _, _ = written
    instances = read_instances(folder / "out" / "instance" / "000000.png")
    single = render_frame(scene, edited, 0, folder / "scene")
    np.testing.assert_array_equal(instances, single.instances)
    rgb = read_image(folder / "out" / "rgb" / "000000.png")
    np.testing.assert_array_equal(rgb[~single.touched], read_photo(scene.root, scene.frames[0])[~single.touched])
    assert (instances == 3).sum() > 200


def test_our_own_reader_finds_the_boxes_in_the_kitti_folder(written):
    folder, scene, _, _, _ = written
    source = open_kitti_mot(folder / "out" / "kitti", sequence="0001")
    frame = source.load(source.frames()[0])
    assert frame.intrinsics == pytest.approx(scene.frames[0].intrinsics)
    assert frame.camera_offset == pytest.approx(scene.frames[0].camera_offset, abs=1e-9)
    found = {known.instance_id: known for known in frame.objects}
    assert sorted(found) == ["km-0001-001", "km-0001-003"]  # "2" is gone, "new-1" has the next free number
    assert found["km-0001-003"].box_center == pytest.approx(INSERTED[0].center, abs=1e-5)
    assert found["km-0001-001"].box_center == pytest.approx(scene.tracks["1"].boxes[0].center, abs=1e-5)
    poses = np.loadtxt(folder / "out" / "kitti" / "poses" / "0001.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(poses[2, :, 3], [0, 0, 2 * STEP_M])
    np.testing.assert_array_equal(
        read_image(folder / "out" / "kitti" / "image_02" / "0001" / "000001.png"),
        read_image(folder / "out" / "rgb" / "000001.png"),
    )


def test_transforms_are_opengl_cameras(written):
    """A point 10 m ahead and 1 m below lies at (0, -1, -10) of an OpenGL camera."""
    folder = written[0]
    value = json.loads((folder / "out" / "transforms.json").read_text())
    frame = value["frames"][2]
    assert (frame["fl_x"], frame["cx"], frame["w"]) == (120.0, 80.0, 160)
    point = np.array(frame["transform_matrix"]) @ np.array([0.0, -1.0, -10.0, 1.0])
    np.testing.assert_allclose(point, [0.0, 1.0, 10.0 + 2 * STEP_M, 1.0])
    assert (folder / "out" / frame["file_path"]).is_file()
    assert (folder / "out" / frame["depth_file_path"]).is_file()


def test_a_stopped_run_goes_on_with_what_is_missing(tmp_path, monkeypatch):
    scene = toy_scene(tmp_path)
    edited = inserted(scene, "9", {0: placed(0.2, 9.0)})
    out, drawn, real = tmp_path / "out", [], writing.draw_frame

    def counted(job):
        if len(drawn) == 2:
            raise KeyboardInterrupt
        drawn.append(job.frame.index)
        return real(job)

    monkeypatch.setattr(writing, "draw_frame", counted)
    with pytest.raises(KeyboardInterrupt):
        write_edited(scene, edited, tmp_path / "scene", out)
    assert not (out / "manifest.json").exists()
    (out / "rgb" / ".x-aaaaaaaa.partial.png").write_bytes(b"half")
    monkeypatch.setattr(writing, "draw_frame", lambda job: drawn.append(job.frame.index) or real(job))
    summary = write_edited(scene, edited, tmp_path / "scene", out)
    assert (summary.kept, drawn) == (2, [0, 1, 2])
    assert not list(out.rglob("*.partial*"))
    whole = tmp_path / "whole"
    write_edited(scene, edited, tmp_path / "scene", whole)
    for path in whole.rglob("*.png"):
        assert (out / path.relative_to(whole)).read_bytes() == path.read_bytes()
    drawn.clear()
    other = inserted(scene, "9", {0: placed(0.4, 9.0)})  # another edit: its frame, and only that, is drawn anew
    assert write_edited(scene, other, tmp_path / "scene", out).kept == 2
    assert drawn == [0]


@pytest.mark.slow
def test_several_processes_write_the_same_bytes(written):
    folder, scene, edited, _, _ = written
    write_edited(scene, edited, folder / "scene", folder / "two", workers=2)
    for path in (folder / "out").rglob("*.png"):
        assert (folder / "two" / path.relative_to(folder / "out")).read_bytes() == path.read_bytes()


def test_a_log_without_poses_says_so(tmp_path):
    scene = toy_scene(tmp_path, frames=1, tracks={"1": [placed(2.0, 10.0)]})
    scene = replace(scene, frames=(replace(scene.frames[0], world_from_camera=None),))
    summary = write_edited(scene, scene.without_track("1"), tmp_path / "scene", tmp_path / "out")
    assert summary.manifest["nerfstudio"] is None
    assert summary.manifest["kitti"]["poses"] is False
    assert not (tmp_path / "out" / "transforms.json").exists()
    assert summary.manifest["frames"][0]["filled_px"] > 0


def test_cars_of_this_log_are_not_foreign(written):
    folder, scene, edited, _, _ = written
    assert foreign_tracks(scene, edited, folder / "scene") == frozenset()


def test_an_empty_scene_is_refused(tmp_path):
    scene = toy_scene(tmp_path, frames=1, tracks={"1": [placed(2.0, 10.0)]})
    empty = replace(scene, frames=(), tracks={})
    with pytest.raises(InputError, match="no frames"):
        write_edited(empty, empty, tmp_path / "scene", tmp_path / "out")
