"""Edits as values: identities, frames of reference, ranges, and what is said when an edit cannot be done."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carstudio.errors import InputError
from carstudio.scene.edit_file import parse_edits
from carstudio.scene.editing import apply_edits
from carstudio.scene.edits import Delete, Edit, Insert, Move, Place, Recolour, Replace, Resize, Rotate, Trajectory
from carstudio.scene.graph import PlacedBox, Scene
from carstudio.scene.path import ego_path
from carstudio.scene.places import heading, pose_of, standing, turn_y
from carstudio.scene.shelf import CarShelf
from scene.made_up_scene import FRAMES, HEIGHT_M, SIZE, camera_pose, made_up_scene, scene_with_cars

Cars = tuple[Scene, CarShelf]


@pytest.fixture(scope="module")
def cars(tmp_path_factory: pytest.TempPathFactory) -> Cars:
    return scene_with_cars(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def unposed(tmp_path_factory: pytest.TempPathFactory) -> Cars:
    return scene_with_cars(tmp_path_factory.mktemp("scene"), has_poses=False)


def done(cars: Cars, *edits: Edit) -> Scene:
    return apply_edits(cars[0], edits, cars[1]).scene


def same_boxes(a: Scene, b: Scene, track: str) -> bool:
    one, other = a.tracks[track].boxes, b.tracks[track].boxes
    return one.keys() == other.keys() and all(
        np.allclose(pose_of(one[i]), pose_of(other[i]), atol=1e-6) and np.allclose(one[i].size, other[i].size)
        for i in one
    )


def in_world(box: PlacedBox, index: int) -> np.ndarray:
    return camera_pose(index)[:3, :3] @ standing(box) + camera_pose(index)[:3, 3]


AHEAD = (Place(at=0, position_m=(0, 10)), Place(at=FRAMES - 1, position_m=(0, 14)))


def test_insert_then_delete_is_the_identity(cars: Cars) -> None:
    assert done(cars, Insert(car="spare", track="new", poses=AHEAD), Delete(track="new")) == cars[0]


def test_the_scene_given_is_left_as_it_was(cars: Cars) -> None:
    before = replace(cars[0])
    done(cars, Move(track="1", translation_m=(1, 0, 0)), Delete(track="2"))
    assert cars[0] == before


@settings(max_examples=15)
@given(
    frame=st.sampled_from(["camera", "car", "world", "path"]),
    way=st.tuples(st.floats(-8, 8), st.floats(-1, 1), st.floats(-4, 4)),
)
def test_there_and_back_again(cars: Cars, frame: str, way: tuple[float, float, float]) -> None:
    back = tuple(-step for step in way)
    there = Move(track="1", translation_m=way, frame=frame)  # type: ignore[arg-type]
    assert same_boxes(done(cars, there, Move(track="1", translation_m=back, frame=frame)), cars[0], "1")  # type: ignore[arg-type]


@settings(max_examples=15)
@given(frame=st.sampled_from(["camera", "car", "world"]), yaw=st.floats(-360, 360))
def test_round_and_back_again(cars: Cars, frame: str, yaw: float) -> None:
    turns = [Rotate(track="1", yaw_deg=angle, frame=frame) for angle in (yaw, -yaw)]  # type: ignore[arg-type]
    assert same_boxes(done(cars, *turns), cars[0], "1")
    assert same_boxes(done(cars, Rotate(track="1", yaw_deg=360)), cars[0], "1")


def test_size_and_back_again(cars: Cars) -> None:
    assert same_boxes(done(cars, Resize(track="1", scale=1.25), Resize(track="1", scale=0.8)), cars[0], "1")


def test_resized_cars_stay_on_the_ground(cars: Cars) -> None:
    box = done(cars, Resize(track="1", size_m=(5.0, 2.5, 2.0))).tracks["1"].boxes[3]
    assert np.allclose(standing(box), standing(cars[0].tracks["1"].boxes[3]), atol=1e-6)
    assert box.size == (5.0, 2.5, 2.0)


MOVES: list[tuple[str, Callable[[np.ndarray, int, PlacedBox], np.ndarray]]] = [
    ("camera", lambda way, index, box: camera_pose(index)[:3, :3] @ way),
    ("car", lambda way, index, box: camera_pose(index)[:3, :3] @ pose_of(box)[:3, :3] @ way),
    ("world", lambda way, index, box: way),
]


@pytest.mark.parametrize(("frame", "expected"), MOVES)
def test_moves_go_along_the_axes_they_name(
    cars: Cars, frame: str, expected: Callable[[np.ndarray, int, PlacedBox], np.ndarray]
) -> None:
    way = np.array([1.5, -0.2, 0.7])
    moved = done(cars, Move(track="1", translation_m=(1.5, -0.2, 0.7), frame=frame))  # type: ignore[arg-type]
    for index, box in cars[0].tracks["1"].boxes.items():
        step = in_world(moved.tracks["1"].boxes[index], index) - in_world(box, index)
        assert np.allclose(step, expected(way, index, box), atol=1e-6)


def test_moving_along_the_path_keeps_the_distance_from_it_and_turns_with_it(cars: Cars) -> None:
    path = ego_path(cars[0])
    assert path is not None
    near = Insert(car="spare", track="n", frame="path", poses=(Place(at=0, position_m=(4, 2)),))
    moved = done(cars, near, Move(track="n", translation_m=(6, 0, 0), frame="path")).tracks["n"].boxes[0]
    (along, _, left), yaw = path.to_path(in_world(moved, 0))
    assert math.isclose(along, 10, abs_tol=1e-6)
    assert math.isclose(left, 2, abs_tol=1e-6)
    assert abs(math.remainder(heading(pose_of(moved)[:3, :3]) - yaw, 2 * math.pi)) < 1e-6
    assert yaw + math.pi / 2 > 0.02  # the road has turned to the right by then


def test_positive_yaw_turns_a_car_to_its_right(cars: Cars) -> None:
    """Brute force: the new front is nearer to the old right side than to the old left one."""
    old = pose_of(cars[0].tracks["1"].boxes[0])
    new = pose_of(done(cars, Rotate(track="1", yaw_deg=30)).tracks["1"].boxes[0])
    right = -old[:3, 2]  # z is the car's left
    assert math.isclose(float(new[:3, 0] @ right), math.sin(math.radians(30)), abs_tol=1e-6)


def test_kittis_yaw_in_camera_poses(cars: Cars) -> None:
    """Yaw 0 looks to the camera's right, -90 away from it, as KITTI's rotation_y."""
    for yaw, front in ((0.0, [1, 0, 0]), (-90.0, [0, 0, 1]), (180.0, [-1, 0, 0])):
        place = Place(at=0, position_m=(0, 12), yaw_deg=yaw)
        box = done(cars, Insert(car="spare", track="new", poses=(place,))).tracks["new"].boxes[0]
        assert np.allclose(pose_of(box)[:3, 0], front, atol=1e-6)


def test_a_car_that_stands_stays_in_the_world_and_on_the_ground(cars: Cars) -> None:
    boxes = done(cars, Insert(car="spare", track="new", poses=AHEAD[:1])).tracks["new"].boxes
    assert len(boxes) == FRAMES
    places = np.array([in_world(box, index) for index, box in boxes.items()])
    assert np.allclose(places, [0, HEIGHT_M, 10], atol=0.03)
    turns = [camera_pose(index)[:3, :3] @ pose_of(box)[:3, :3] for index, box in boxes.items()]
    assert np.allclose(turns, turns[0], atol=1e-6)


def test_without_poses_a_car_keeps_its_place_before_the_camera(unposed: Cars) -> None:
    boxes = done(unposed, Insert(car="spare", track="new", poses=AHEAD[:1])).tracks["new"].boxes
    assert np.allclose([box.center for box in boxes.values()], boxes[0].center, atol=1e-6)
    assert np.allclose(pose_of(boxes[0])[:3, 0], [0, 0, 1], atol=1e-6)  # along the road: where the camera looks
    with pytest.raises(InputError, match=r"world needs the camera's pose, which frame 0 does not have; use camera"):
        done(unposed, Move(track="1", translation_m=(1, 0, 0), frame="world"))
    moved = done(unposed, Move(track="1", translation_m=(2, 0, 1), frame="path")).tracks["1"].boxes[0]
    assert np.allclose(standing(moved) - standing(unposed[0].tracks["1"].boxes[0]), [-1, 0, 2], atol=1e-6)


def test_a_driving_car_is_halfway_at_half_time_and_faces_its_way(cars: Cars) -> None:
    poses = (Place(at=2, position_m=(5, 1.0)), Place(at=10, position_m=(21, 1.0)))
    track = done(cars, Insert(car="spare", track="new", frame="path", poses=poses)).tracks["new"]
    assert sorted(track.boxes) == list(range(2, 11))
    path = ego_path(cars[0])
    assert path is not None
    for index, box in track.boxes.items():
        (along, _, left), yaw = path.to_path(in_world(box, index))
        assert math.isclose(along, 5 + 2 * (index - 2), abs_tol=1e-5)
        assert math.isclose(left, 1.0, abs_tol=1e-5)
        turn = camera_pose(index)[:3, :3] @ pose_of(box)[:3, :3]
        assert np.allclose(turn, turn_y(yaw), atol=1e-6)


def test_turns_take_the_short_way(cars: Cars) -> None:
    poses = (Place(at=0, position_m=(0, 12), yaw_deg=170), Place(at=10, position_m=(0, 12), yaw_deg=-170))
    boxes = done(cars, Insert(car="spare", track="new", frame="world", poses=poses)).tracks["new"].boxes
    middle = camera_pose(5)[:3, :3] @ pose_of(boxes[5])[:3, :3]
    assert abs(abs(heading(middle)) - math.pi) < 1e-6


def test_a_trajectory_from_the_cars_own_place(cars: Cars) -> None:
    poses = (Place(at=0, position_m=(0, 0)), Place(at=11, position_m=(6, 0)))
    track = done(cars, Trajectory(track="1", frame="car", poses=poses)).tracks["1"]
    start, end = (in_world(track.boxes[index], index) for index in (0, 11))
    assert np.allclose(start, in_world(cars[0].tracks["1"].boxes[0], 0), atol=0.03)
    assert np.allclose(end - start, [0, 0, 6], atol=0.03)  # track 1 drives away: its front is world z
    assert np.allclose(np.array(track.boxes[5].size), SIZE)


def test_edits_of_a_range_leave_the_other_frames_to_the_photographs(cars: Cars) -> None:
    track = done(cars, Move(track="1", translation_m=(1, 0, 0), frames=(3, 5))).tracks["1"]
    old = cars[0].tracks["1"]
    assert [index for index in track.boxes if track.is_drawn_at(index)] == [3, 4, 5]
    assert all((track.boxes[index] == old.boxes[index]) == (index not in (3, 4, 5)) for index in old.boxes)
    both = done(
        cars,
        Move(track="1", translation_m=(1, 0, 0), frames=(3, 5)),
        Rotate(track="1", yaw_deg=5, frames=(8, 8)),
    ).tracks["1"]
    assert both.drawn_in == {3, 4, 5, 8}
    assert done(cars, Move(track="1", translation_m=(1, 0, 0))).tracks["1"].drawn_in is None


def test_deleting_a_range_keeps_the_rest(cars: Cars) -> None:
    scene = done(cars, Delete(track="1", frames=(0, 3)))
    assert sorted(scene.tracks["1"].boxes) == list(range(4, FRAMES)) == sorted(scene.tracks["1"].labels)
    assert not scene.tracks["1"].is_drawn
    moved = done(cars, Move(track="1", translation_m=(1, 0, 0), frames=(2, 6)), Delete(track="1", frames=(0, 3)))
    assert moved.tracks["1"].drawn_in == {4, 5, 6}


def test_replacing_puts_another_car_where_the_old_one_stood(cars: Cars) -> None:
    track = done(cars, Replace(track="3", car="spare")).tracks["3"]
    assert track.car == cars[1].ref("spare")
    assert track.is_drawn
    for index, box in track.boxes.items():
        assert np.allclose(standing(box), standing(cars[0].tracks["3"].boxes[index]), atol=1e-6)
        assert box.size == (4.6, 1.4, 1.9)
    assert done(cars, Replace(track="1", car="track:2")).tracks["1"].car == cars[0].tracks["2"].car


def test_another_look_for_a_range_splits_the_track(cars: Cars) -> None:
    scene = done(cars, Replace(track="1", car="spare", frames=(4, 6)))
    part, rest = scene.tracks["1.4-6"], scene.tracks["1"]
    assert sorted(part.boxes) == [4, 5, 6]
    assert sorted(rest.boxes) == [0, 1, 2, 3, 7, 8, 9, 10, 11]
    assert part.car == cars[1].ref("spare")
    assert rest == replace(
        cars[0].tracks["1"],
        boxes={i: box for i, box in cars[0].tracks["1"].boxes.items() if i not in (4, 5, 6)},
        labels={i: label for i, label in cars[0].tracks["1"].labels.items() if i not in (4, 5, 6)},
    )


EDITS = [
    Insert(car="spare", track="new", frame="path", poses=(Place(at=0, position_m=(9, 0)),)),
    Move(track="1", translation_m=(1, 0, 0), frame="world"),
    Rotate(track="2", yaw_deg=15),
    Delete(track="3", frames=(5, 6)),
    Replace(track="7", car="spare"),
]


def test_the_order_of_tracks_changes_nothing(cars: Cars) -> None:
    scene, shelf = cars
    turned = replace(scene, tracks=dict(reversed(scene.tracks.items())))
    one, other = apply_edits(scene, EDITS, shelf), apply_edits(turned, EDITS, shelf)
    assert one.scene == other.scene
    assert set(one.warnings) == set(other.warnings)


def test_edits_of_different_tracks_can_be_done_in_any_order(cars: Cars) -> None:
    assert done(cars, *EDITS) == done(cars, *reversed(EDITS))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ("{op: move, track: 11, translation_m: [1, 0, 0]}", "e line 3: no track '11'; did you mean '1'? tracks: 1, 2,"),
        ("{op: move, track: 1, frames: 90-99, translation_m: [1, 0, 0]}", "e line 3: the scene has no frame of 90-99"),
        ("{op: move, track: 3, frames: 0-2, translation_m: [1, 0, 0]}", "track 3 has no box in these frames; .* 4-11"),
        ("{op: move, track: 3, translation_m: [1, 0, 0]}", "e line 3: track 3 has no car .* deleted or replaced"),
        ("{op: replace, track: 1, car: spar}", "e line 3: no car 'spar'; did you mean 'spare'? cars: spare, track-1"),
        ("{op: replace, track: 1, car: 'track:3'}", "e line 3: no car of a track '3'.* tracks with a car: 1, 2, 7"),
        ("{op: recolour, track: 1, colour: bleu}", "e line 3: colour 'bleu': expected '#rrggbb'"),
        ("{op: insert, car: spare, track: 1, poses: [{at: 0, position_m: [0, 9]}]}", "e line 3: there is a track '1'"),
        ("{op: insert, car: spare, frame: car, poses: [{at: 0, position_m: [0, 9]}]}", "has no box to count from"),
        ("{op: insert, car: spare, track: a/b, poses: [{at: 0, position_m: [0, 9]}]}", "e line 3: track 'a/b': exp"),
        ("{op: trajectory, track: 7, frame: car, poses: [{at: 50, position_m: [0, 9]}]}", "e line 3: .*in frame 50"),
        (
            "{op: insert, car: spare, poses: [{at: 0, position_m: [0, 9]}, {at: 0, position_m: [0, 8]}]}",
            "e line 3: two poses at frame 0",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_done_is_told_with_its_line(cars: Cars, edit: str, message: str) -> None:
    edits = parse_edits(f"version: 1\nedits:\n  - {edit}", name="e")
    with pytest.raises(InputError, match=message.replace("?", r"\?")):
        apply_edits(cars[0], edits, cars[1])


def test_without_a_file_the_edit_is_named_by_number(cars: Cars) -> None:
    edits = [Move(track="1", translation_m=(1, 0, 0)), Delete(track="one")]
    with pytest.raises(InputError, match=r"edit 2 \(delete\): no track 'one'"):
        apply_edits(cars[0], edits, cars[1])


def test_an_id_that_an_edit_took_away_is_unknown_to_the_next(cars: Cars) -> None:
    with pytest.raises(InputError, match=r"edit 2 \(move\): no track '1'; .*tracks: 2, 3, 7"):
        apply_edits(cars[0], [Delete(track="1"), Move(track="1", translation_m=(1, 0, 0))], cars[1])


def test_warnings_name_what_looks_wrong(cars: Cars) -> None:
    def told(*edits: Edit) -> str:
        return "; ".join(apply_edits(cars[0], edits, cars[1]).warnings)

    assert told(Rotate(track="1", yaw_deg=3)) == ""
    assert told(Move(track="1", translation_m=(0, -1, 0), frames=(2, 4))) == (
        "track 1: off the ground by more than 0.4 m in frames 2-4"
    )
    assert "track 1: stands in track 2 in frames 0-11" in told(Move(track="1", translation_m=(0, 0, 5), frame="world"))
    assert told(
        Insert(car="spare", track="n", frame="camera", poses=(Place(at=0, position_m=(0, -9)),), frames=(0, 1))
    ) == ("track n: out of view in frames 0-1")


def test_a_car_from_elsewhere_comes_onto_the_shelf(cars: Cars, tmp_path: Path) -> None:
    scene, shelf = scene_with_cars(tmp_path / "scene")
    outside = CarShelf(tmp_path / "other")
    outside.add(shelf.load(shelf.ref("spare")), "mine")
    known = replace(shelf, more=(outside.folder("mine"),))
    edited = apply_edits(scene, [Replace(track="1", car="mine")], known).scene
    assert edited.tracks["1"].car == shelf.ref("mine")
    with pytest.raises(InputError, match="--cars FOLDER"):
        apply_edits(scene, [Replace(track="2", car="theirs")], known)


def test_a_car_that_was_exchanged_is_refused(tmp_path: Path) -> None:
    scene, shelf = scene_with_cars(tmp_path)
    shelf.add(shelf.load(shelf.ref("spare")), "track-1")
    with pytest.raises(InputError, match="not the car that the scene speaks of"):
        apply_edits(scene, [Recolour(track="1", colour="red")], shelf)


def test_an_empty_scene_takes_no_edit_and_no_harm(cars: Cars) -> None:
    empty = replace(made_up_scene(), tracks={})
    assert apply_edits(empty, [], cars[1]).scene == empty
    with pytest.raises(InputError, match="tracks: none"):
        apply_edits(empty, [Delete(track="1")], cars[1])
