"""Random traffic: nothing touches anything, all on the ground, along the road, the same for the same seed."""

import math

import numpy as np
import pytest

from carstudio.cli import run
from carstudio.errors import InputError
from carstudio.scene.editing import apply_edits
from carstudio.scene.graph import Scene
from carstudio.scene.path import ego_path
from carstudio.scene.places import collide, heading, pose_of, standing
from carstudio.scene.random_edits import random_traffic
from carstudio.scene.scene_file import load_scene, save_scene
from carstudio.scene.shelf import CarShelf
from scene.made_up_scene import FRAMES, HEIGHT_M, camera_pose, scene_with_cars

Cars = tuple[Scene, CarShelf]


@pytest.fixture(scope="module")
def cars(tmp_path_factory: pytest.TempPathFactory) -> Cars:
    return scene_with_cars(tmp_path_factory.mktemp("scene"))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_cars_find_room_on_the_road(cars: Cars, seed: int) -> None:
    traffic = random_traffic(cars[0], cars[1], 3, seed=seed)
    scene = apply_edits(cars[0], traffic.edits, cars[1]).scene
    new = [track for name, track in scene.tracks.items() if name not in cars[0].tracks]
    assert len(new) == 3 - (1 if traffic.problems else 0) * (3 - len(traffic.edits))
    path = ego_path(cars[0])
    assert path is not None
    for track in new:
        assert sorted(track.boxes) == list(range(FRAMES))
        for index, box in track.boxes.items():
            others = [other.boxes.get(index) for other in scene.tracks.values() if other is not track]
            assert not any(other is not None and collide(box, other) for other in others)
            world = camera_pose(index)[:3, :3] @ standing(box) + camera_pose(index)[:3, 3]
            assert abs(world[1] - HEIGHT_M) < 0.1
            (_, _, left), yaw = path.to_path(world)
            turn = heading(camera_pose(index)[:3, :3] @ pose_of(box)[:3, :3])
            assert abs(math.sin(turn - yaw)) < 1e-3  # along the road, one way or the other
            assert -1 < left < 4.5
            assert math.hypot(*standing(box)[[0, 2]]) > 2.5  # not in the car that carries the camera


def test_a_seed_is_a_seed(cars: Cars) -> None:
    once, again = (random_traffic(cars[0], cars[1], 3, seed=4) for _ in range(2))
    assert once == again
    assert once != random_traffic(cars[0], cars[1], 3, seed=5)


def test_a_full_road_says_so(cars: Cars) -> None:
    traffic = random_traffic(cars[0], cars[1], 40, seed=0)
    assert 1 <= len(traffic.edits) < 40
    assert traffic.problems == (f"no room for {40 - len(traffic.edits)} of 40 cars",)


def test_without_poses_cars_stand_before_the_camera(tmp_path_factory: pytest.TempPathFactory) -> None:
    scene, shelf = scene_with_cars(tmp_path_factory.mktemp("scene"), has_poses=False)
    traffic = random_traffic(scene, shelf, 2, seed=0)
    boxes = list(apply_edits(scene, traffic.edits, shelf).scene.tracks["random-1"].boxes.values())
    assert np.allclose(np.abs(pose_of(boxes[0])[:3, 0]), [0, 0, 1], atol=1e-6)
    with pytest.raises(InputError, match="--random must be at least 1"):
        random_traffic(scene, shelf, 0, seed=0)


def test_the_verb_edits_by_file_and_by_chance(
    cars: Cars, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = cars[1].scene_folder
    save_scene(folder, cars[0])
    out = tmp_path_factory.mktemp("out")
    assert run(["edit", str(folder), "--random", "2", "--seed", "3", "--out", str(out / "a"), "--dry-run"]) == 0
    made = load_scene(out / "a/scene")
    assert {"random-1", "random-2"} <= set(made.tracks)
    again = ["edit", str(folder), str(out / "a/scene/edits.yaml"), "--out", str(out / "b"), "--dry-run"]
    assert run(again) == 0  # the file that chance wrote gives the same scene
    assert load_scene(out / "b/scene") == made
    (out / "bad.yaml").write_text("version: 1\nedits:\n  - {op: delete, track: 12}\n")
    capsys.readouterr()
    assert run(["edit", str(folder), str(out / "bad.yaml"), "--out", str(out / "c"), "--dry-run"]) == 2
    assert "bad.yaml line 3: no track '12'; did you mean" in capsys.readouterr().err
    assert run(["edit", str(folder), "--out", str(out / "c")]) == 2
    assert "expected either an edit file or --random N" in capsys.readouterr().err
