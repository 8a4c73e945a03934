"""Scenes on disk: equal after a round trip, and nothing believed that cannot be true."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.errors import InputError
from carstudio.scene.graph import CarRef, FileRef
from carstudio.scene.scene_file import SCENE_FILE, load_scene, read_ref, save_scene, scene_from_json
from scene.made_up_scene import made_up_scene


def stored(tmp_path: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(save_scene(tmp_path, made_up_scene()).read_text())
    return value


def test_a_scene_comes_back_as_it_was(tmp_path: Path) -> None:
    scene = made_up_scene()
    track = replace(scene.tracks["1"], is_drawn=True, drawn_in=frozenset({3, 1}), car=CarRef("track-1", "a" * 64))
    scene = scene.with_track(track)
    path = save_scene(tmp_path / "a", scene)
    assert load_scene(tmp_path / "a") == scene
    assert save_scene(tmp_path / "b", load_scene(tmp_path / "a")).read_bytes() == path.read_bytes()


def test_an_empty_scene_comes_back(tmp_path: Path) -> None:
    scene = replace(made_up_scene(), frames=(), tracks={})
    save_scene(tmp_path, scene)
    assert load_scene(tmp_path) == scene


def test_the_log_may_have_moved(tmp_path: Path) -> None:
    save_scene(tmp_path, made_up_scene())
    assert load_scene(tmp_path, root="/elsewhere").root == "/elsewhere"


def test_a_newer_version_is_refused_with_the_way_out(tmp_path: Path) -> None:
    value = stored(tmp_path) | {"format_version": 2}
    (tmp_path / SCENE_FILE).write_text(json.dumps(value))
    with pytest.raises(InputError, match=r"expected format_version 1, found 2; update carstudio"):
        load_scene(tmp_path)


@pytest.mark.parametrize("path", ["../x.png", "/etc/passwd", "a/../../b", "C:/x", "", "a\\b", "a\0b"])
def test_no_path_leaves_its_folder(tmp_path: Path, path: str) -> None:
    value = stored(tmp_path)
    value["scene"]["frames"][0]["image"]["path"] = path
    with pytest.raises(InputError, match="must be relative and stay below its folder"):
        scene_from_json(value["scene"], name="scene.json")


def broken(scene: dict[str, Any], what: str) -> None:
    frame, box = scene["frames"][1], scene["tracks"]["1"]["boxes"]["2"]
    {
        "nan": lambda: frame["intrinsics"].__setitem__(0, float("nan")),
        "huge": lambda: box["center"].__setitem__(0, 1e30),
        "order": lambda: scene["frames"].reverse(),
        "twice": lambda: scene["frames"].append(frame),
        "name": lambda: frame.update(name="../x"),
        "focal": lambda: frame["intrinsics"].__setitem__(0, -7.0),
        "sides": lambda: frame.update(width=0),
        "pose": lambda: frame["world_from_camera"].pop(),
        "size": lambda: box["size"].__setitem__(1, 0.0),
        "turn": lambda: box["rotation"].__setitem__(0, 3.0),
        "frame": lambda: scene["tracks"]["1"]["boxes"].update({"99": box}),
        "id": lambda: scene["tracks"].update({"8": scene["tracks"]["1"]}),
        "word": lambda: box["center"].__setitem__(0, "far"),
        "gone": lambda: scene.pop("frames"),
        "car": lambda: scene["tracks"]["1"].update(car={"name": "../../car", "sha256": ""}),
    }[what]()


@pytest.mark.parametrize(
    "what",
    "nan huge order twice name focal sides pose size turn frame id word gone car".split(),
)
def test_what_cannot_be_is_refused_by_name(tmp_path: Path, what: str) -> None:
    scene = stored(tmp_path)["scene"]
    broken(scene, what)
    with pytest.raises(InputError, match=r"scene\.json"):
        scene_from_json(scene, name="scene.json")


@given(st.data())
def test_a_damaged_file_is_refused_or_read(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("scene")
    path = save_scene(folder, replace(made_up_scene(), tracks={}))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        load_scene(folder)
    except InputError:
        return
    assert scene_from_json(json.loads(content)["scene"], name="scene.json") == load_scene(folder)


def test_a_photograph_is_the_one_the_scene_was_made_from(tmp_path: Path) -> None:
    (tmp_path / "photo.png").write_bytes(b"pixels")
    scene = replace(made_up_scene(), root=str(tmp_path))
    ref = FileRef("photo.png", hashlib.sha256(b"pixels").hexdigest())
    assert read_ref(scene, ref, "photograph") == b"pixels"
    (tmp_path / "photo.png").write_bytes(b"others")
    with pytest.raises(InputError, match="sha256 differs"):
        read_ref(scene, ref, "photograph")
    with pytest.raises(InputError, match="cannot be read"):
        read_ref(scene, FileRef("gone.png", ""), "photograph")
