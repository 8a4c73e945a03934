"""Drawn frames: what no edit touches keeps its bytes, what it touches stays within old and new footprint and shadow."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from carstudio.errors import InputError
from carstudio.scene.drawing import DrawnFrame, draw_frame, read_photo, render_frame
from carstudio.scene.footprint import any_of, body_mask, ground_mask, outline_mask
from carstudio.scene.frame_jobs import DrawingSettings, Sensor, drawing_settings, frame_job
from carstudio.scene.graph import Scene, Track
from carstudio.scene.ground import find_ground
from carstudio.scene.truth import bounding_box
from scene.toy_log import WALL, inserted, photograph, placed, shelve, toy_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("toy")


@pytest.fixture(scope="module")
def scene(folder) -> Scene:
    return toy_scene(folder)


def drawn(folder, scene: Scene, edited: Scene, index: int = 0, **settings) -> DrawnFrame:
    return render_frame(scene, edited, index, folder / "scene", settings=DrawingSettings(**settings))


def moved(scene: Scene, dx: float, dz: float) -> Scene:
    track = scene.tracks["1"]
    boxes = {i: placed(b.center[0] + dx, b.center[2] + dz) for i, b in track.boxes.items()}
    return scene.with_track(replace(track, boxes=boxes, is_drawn=True))


def test_without_edits_every_byte_is_the_photographs(folder, scene):
    frame = drawn(folder, scene, scene)
    np.testing.assert_array_equal(frame.rgb, read_photo(scene.root, scene.frames[0]))
    assert not frame.touched.any()
    assert {t.track_id: t.occlusion for t in frame.truths} == {"1": 1, "2": 1}  # the log's own labels
    assert frame.truths[0].box2d == (10.0, 10.0, 50.0, 50.0)


def test_insert_then_delete_is_the_identity(folder, scene):
    there_and_back = inserted(scene, "9", {0: placed(0.0, 9.0)}).without_track("9")
    np.testing.assert_array_equal(drawn(folder, scene, there_and_back).rgb, photograph(0, boxes_of(scene, 0)))


def boxes_of(scene: Scene, index: int):
    return tuple(track.boxes[index] for track in scene.tracks.values() if index in track.boxes)


@pytest.mark.parametrize(("dx", "dz"), [(-2.6, -3.0), (0.0, 6.0), (-60.0, 0.0), (0.0, -30.0)])
def test_an_edit_changes_nothing_outside_old_and_new_footprint_and_shadow(folder, scene, dx, dz):
    """Also when the new place is out of view, or behind the camera."""
    edited = moved(scene, dx, dz)
    frame = draw_frame(replace(frame_job(scene, edited, 0, str(folder / "scene")), sensor=Sensor(0.45, 0.004)))
    camera = scene.frames[0].camera()
    ground = find_ground(None, [scene.tracks["1"].boxes[0], scene.tracks["2"].boxes[0]])
    old, new = scene.tracks["1"].boxes[0], edited.tracks["1"].boxes[0]
    allowed = any_of(
        (
            body_mask(old, camera, grow_px=3),
            ground_mask(old, ground, camera),
            outline_mask(new, camera, grow_px=1),
            ground_mask(new, ground, camera),
        ),
        camera,
    )
    photo = read_photo(scene.root, scene.frames[0])
    changed = (frame.rgb != photo).any(axis=-1)
    assert changed.any()
    assert not (changed & ~allowed).any()
    assert not (changed & ~frame.touched).any()


def test_the_order_of_tracks_changes_nothing(folder, scene):
    edited = inserted(inserted(scene, "8", {0: placed(0.3, 9.0)}), "9", {0: placed(0.9, 10.5, 0.4)})
    turned = replace(edited, tracks=dict(reversed(edited.tracks.items())))
    one, other = drawn(folder, scene, edited), drawn(folder, scene, turned)
    for kind in ("rgb", "instances", "semantic", "depth_m"):
        np.testing.assert_array_equal(getattr(one, kind), getattr(other, kind))


def test_boxes_and_occlusion_are_counted_pixels(folder, scene):
    """Against each car drawn alone: what it covers then, and what is left of it in the company of the others."""
    boxes = {"8": placed(0.2, 8.0), "9": placed(0.9, 11.0)}
    edited = scene
    for name, box in boxes.items():
        edited = inserted(edited, name, {0: box})
    frame = drawn(folder, scene, edited, depth="ground")
    truth = {t.track_id: t for t in frame.truths}
    for name, box in boxes.items():
        single = drawn(folder, scene, inserted(scene, name, {0: box}), depth="ground")
        alone = single.instances == next(t.number for t in single.truths if t.track_id == name)
        visible = frame.instances == truth[name].number
        share = 1 - (visible & alone).sum() / alone.sum()
        assert truth[name].occluded_share == pytest.approx(share, abs=0.03)  # half-covered pixels count either way
        assert truth[name].num_pixels == visible.sum()
        rows, columns = np.nonzero(visible)
        expected = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        assert truth[name].box2d == tuple(float(value) for value in expected)
        assert bounding_box(visible) == truth[name].box2d
    assert truth["9"].occluded_share > 0.3
    assert truth["8"].occluded_share < 0.02
    assert truth["9"].occlusion in (1, 2)


def test_a_deleted_car_is_filled_with_the_road_that_other_frames_show(tmp_path):
    """The car drives ahead of us: later frames show the road it stood on."""
    scene = toy_scene(tmp_path, frames=8, tracks={"1": [placed(0.0, 8.0 + 2.0 * i) for i in range(8)]})
    frame = drawn(tmp_path, scene, scene.without_track("1"), 0)
    true = photograph(0)
    hole = outline_mask(scene.tracks["1"].boxes[0], scene.frames[0].camera())
    on_road = hole & (np.mgrid[:96, :160][0] > 46)
    wrong = np.abs(frame.rgb.astype(float) - true).mean(axis=-1)[on_road]
    blind = drawn(tmp_path, scene, scene.without_track("1"), 0, fills_from_frames=False)
    painted = np.abs(blind.rgb.astype(float) - true).mean(axis=-1)[on_road]
    assert frame.filled_from_frames_px > 0.4 * frame.filled_px
    assert blind.filled_from_frames_px == 0
    assert np.median(wrong) < 6
    assert np.median(wrong) < np.median(painted) / 2
    assert not (np.abs(frame.rgb[on_road].astype(float) - WALL) < 20).all(axis=-1).any()  # no bit of the car is left


def test_wrong_poses_cost_a_worse_fill_and_not_a_wrong_one(tmp_path):
    scene = toy_scene(tmp_path, frames=6, tracks={"1": [placed(0.0, 8.0 + 2.0 * i) for i in range(6)]})
    aside = np.eye(4)
    aside[0, 3] = 1.5
    frames = tuple(
        replace(f, world_from_camera=tuple(tuple(r) for r in (aside @ np.array(f.world_from_camera)).tolist()))
        if f.index
        else f
        for f in scene.frames
    )
    broken = replace(scene, frames=frames)
    assert drawn(tmp_path, broken, broken.without_track("1"), 0).filled_from_frames_px == 0


def test_cars_are_hidden_by_undrawn_cars_that_stand_before_them(folder, scene):
    near = scene.tracks["1"].boxes[0]
    edited = inserted(scene, "9", {0: placed(near.center[0], near.center[2] + 6.0)})
    frame = drawn(folder, scene, edited, depth="ground")
    behind = next(t for t in frame.truths if t.track_id == "9")
    assert behind.occluded_share > 0.4
    photo = read_photo(scene.root, scene.frames[0])
    core = frame.instances == next(t.number for t in frame.truths if t.track_id == "1")
    same = (frame.rgb == photo).all(axis=-1)
    assert same[core].mean() > 0.8  # but for its glass and its rim


def test_drawn_cars_hide_photographed_ones_in_the_labels(folder, scene):
    far = scene.tracks["1"].boxes[0]
    edited = inserted(scene, "9", {0: placed(far.center[0] - 0.7, far.center[2] - 5.0)})
    frame = drawn(folder, scene, edited, depth="ground")
    behind = next(t for t in frame.truths if t.track_id == "1")
    assert behind.occlusion == 2
    assert behind.box2d is None or behind.box2d != (10.0, 10.0, 50.0, 50.0)


def test_a_track_drawn_in_some_frames_is_the_photographs_in_others(folder, scene):
    track = replace(scene.tracks["1"], is_drawn=True, drawn_in=frozenset({1}))
    edited = scene.with_track(track)
    assert not drawn(folder, scene, edited, 0).touched.any()
    assert drawn(folder, scene, edited, 1).touched.any()


def test_four_rays_a_pixel_draw_the_same_car(folder, scene):
    edited = inserted(scene, "9", {0: placed(0.0, 9.0)})
    fast, fine = (drawn(folder, scene, edited, rays_per_side=side, is_matched=False) for side in (1, 2))
    difference = np.abs(fast.rgb.astype(float) - fine.rgb)
    assert difference.mean() < 0.5
    assert (fast.instances != fine.instances).mean() < 0.005


def test_empty_frames_and_tracks_without_a_car(folder, scene):
    empty = replace(scene, tracks={})
    frame = drawn(folder, empty, empty)
    assert frame.truths == ()
    np.testing.assert_array_equal(frame.rgb, photograph(0, boxes_of(scene, 0)))
    unlifted = replace(scene, tracks={"1": replace(scene.tracks["1"], car=None)})
    frame = drawn(folder, unlifted, unlifted)
    assert frame.truths[0].num_pixels is None
    assert (frame.semantic == 255).any()
    with pytest.raises(InputError, match="track 1, frame 0: has no car"):
        drawn(folder, unlifted, unlifted.with_track(replace(unlifted.tracks["1"], is_drawn=True)))
    with pytest.raises(InputError, match="moved or new, but left to the photograph"):
        drawn(folder, scene, scene.with_track(Track(track_id="7", boxes={0: placed(0.0, 9.0)})))


def test_a_photograph_or_car_that_has_changed_is_refused(tmp_path):
    scene = toy_scene(tmp_path, frames=2, tracks={"1": [placed(2.0, 10.0), placed(2.0, 9.0)]})
    photo = tmp_path / "log" / scene.frames[1].image.path
    photo.write_bytes(photo.read_bytes() + b" ")
    with pytest.raises(InputError, match="not the one that the scene was made from"):
        drawn(tmp_path, scene, scene, 1)
    shelve(tmp_path / "scene", "track-1", 5)
    with pytest.raises(InputError, match="not the car that the scene speaks of"):
        drawn(tmp_path, scene, scene, 0)


def test_a_car_cut_by_the_border_is_truncated(folder, scene):
    frame = drawn(folder, scene, inserted(scene, "9", {0: placed(-4.6, 7.0)}))
    truth = next(t for t in frame.truths if t.track_id == "9")
    assert 0.2 < truth.truncation < 0.9
    assert truth.box2d is not None
    assert truth.box2d[0] == 0.0


def test_a_depth_network_hides_cars_behind_what_it_sees(folder, scene, monkeypatch):
    """A network whose inverse depth is exact but for scale and shift: a wall 6 m ahead hides a car 9 m ahead."""
    from carstudio.scene import drawing

    camera = scene.frames[0].camera()
    ground = find_ground(None, boxes_of(scene, 0))
    depth = np.where(np.isfinite(ground.depth(camera)), ground.depth(camera), 80.0)
    depth[:60, 60:100] = np.minimum(depth[:60, 60:100], 6.0)
    monkeypatch.setattr(drawing, "estimate_inverse_depth", lambda name, photo: 3.0 / depth + 0.2)
    edited = inserted(scene, "9", {0: placed(0.0, 9.0)})
    hidden, free = (drawn(folder, scene, edited, depth_network=name) for name in ("wall", None))
    seen = [next(t.num_pixels for t in frame.truths if t.track_id == "9") for frame in (hidden, free)]
    assert seen[0] < 0.3 * seen[1]  # below row 60 its wheels are before the wall


def test_no_shadow_falls_on_what_is_no_ground(folder, scene, monkeypatch):
    """A network sees something 2 m ahead on the left: neither the car nor its shadow changes a pixel of it."""
    from carstudio.scene import drawing

    depth = find_ground(None, boxes_of(scene, 0)).depth(scene.frames[0].camera())
    depth = np.where(np.isfinite(depth), depth, 80.0)
    depth[55:, :75] = 2.0
    monkeypatch.setattr(drawing, "estimate_inverse_depth", lambda name, photo: np.zeros(photo.shape[:2]))
    monkeypatch.setattr(drawing, "align_depth", lambda inverse, known: depth)
    edited = inserted(scene, "9", {0: placed(0.0, 9.0)})
    assert drawn(folder, scene, edited).touched[55:, :75].any()
    frame = drawn(folder, scene, edited, depth_network="near")
    assert not frame.touched[55:, :75].any()
    assert frame.touched[55:, 76:].any()


def test_depth_is_asked_for_by_name():
    assert drawing_settings("fast") == DrawingSettings()
    assert drawing_settings("fine", depth="ground") == DrawingSettings(rays_per_side=2, depth="ground")
    named = drawing_settings("fast", depth="transformers:some/network", model=Path("run"))
    assert (named.depth_network, named.model, named.depth) == ("some/network", "run", "auto")
    for wrong in ("lidar", "transformers:", "onnx:x"):
        with pytest.raises(InputError, match="--depth must be auto, ground or transformers:NAME_OR_FOLDER"):
            drawing_settings("fast", depth=wrong)
