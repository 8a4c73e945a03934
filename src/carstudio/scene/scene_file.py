"""A scene on disk: `scene.json` beside `cars/NAME/` (one CAR folder each). Photographs stay where the log is.

What the file says is checked before anybody uses it: format version, numbers, boxes, and that no path leaves its
folder.
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from pydantic import TypeAdapter, ValidationError

from carstudio.dataset.schema import check_id
from carstudio.errors import InputError, shortened
from carstudio.files import parse_json, read_bounded, write_json
from carstudio.scene.graph import FileRef, PlacedBox, Scene, SceneFrame, Track

SCENE_FILE = "scene.json"
FORMAT, FORMAT_VERSION = "carstudio-scene", 1
MAX_FILE_BYTES = 2**30
_MOST = 1e6  # of any number in a scene, as in KITTI's files
_MOST_SIDE_PX = 65_535
_UNIT = 1e-3  # of a quaternion's length


def save_scene(folder: Path | str, scene: Scene) -> Path:
    """Write `scene.json` atomically; equal scenes give equal bytes. Returns the file."""
    path = Path(folder) / SCENE_FILE
    write_json(path, {"format": FORMAT, "format_version": FORMAT_VERSION, "scene": _plain(scene)})
    return path


def load_scene(folder: Path | str, *, root: Path | str | None = None) -> Scene:
    """Read and check a scene; `root` says where its log lies now, when that has moved.

    `InputError` names the file, the field and what is wrong with it; newer versions are refused.
    """
    path = Path(folder) / SCENE_FILE
    if not path.is_file():
        raise InputError(f"{folder}: expected a scene ({SCENE_FILE}), found none; see `carstudio scene`")
    value = parse_json(read_bounded(path, "scene", max_bytes=MAX_FILE_BYTES), name=str(path))
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise InputError(
            f"{path}: expected format {FORMAT!r}, found {shortened(value)}; make it with `carstudio scene`"
        )
    version = value.get("format_version")
    if version != FORMAT_VERSION:
        raise InputError(f"{path}: expected format_version {FORMAT_VERSION}, found {version!r}; update carstudio")
    scene = scene_from_json(value.get("scene"), name=str(path))
    return scene if root is None else replace(scene, root=str(root))


def scene_from_json(value: Any, *, name: str) -> Scene:
    """A checked scene from JSON values; `name` is the file for messages."""
    _check_numbers(value, name)
    try:
        scene: Scene = TypeAdapter(Scene).validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{name}: field {where!r}: {first['msg']}, found {shortened(first.get('input'))}") from error
    check_scene(scene, name=name)
    return scene


def check_scene(scene: Scene, *, name: str) -> None:
    """`InputError` unless frames are in order, names can be file names, and boxes are boxes."""
    indices = [frame.index for frame in scene.frames]
    if indices != sorted(set(indices)):
        raise InputError(f"{name}: frames must be in ascending order of their index, each once")
    if len({frame.name for frame in scene.frames}) != len(indices):
        raise InputError(f"{name}: two frames have one name; names must differ")
    for frame in scene.frames:
        _check_frame(frame, name)
    for key, track in scene.tracks.items():
        _check_track(key, track, set(indices), name)


def read_ref(scene: Scene, ref: FileRef, what: str, *, max_bytes: int = 2**30) -> bytes:
    """The bytes of a file of the log; `InputError` when it is gone or is not the one the scene was made from."""
    check_path(ref.path, name=what)
    data = read_bounded(Path(scene.root) / ref.path, what, max_bytes=max_bytes)
    if hashlib.sha256(data).hexdigest() != ref.sha256:
        raise InputError(
            f"{Path(scene.root) / ref.path}: {what} is not the file that the scene was made from (its sha256 differs); "
            "restore it, or make the scene again"
        )
    return data


def check_path(path: str, *, name: str) -> None:
    """`InputError` for a path that does not stay below its folder."""
    pure = PurePosixPath(path)
    if not path or pure.is_absolute() or ".." in pure.parts or "\0" in path or "\\" in path or ":" in pure.parts[0]:
        raise InputError(f"{name}: path {path!r} must be relative and stay below its folder, with forward slashes")


def _check_frame(frame: SceneFrame, name: str) -> None:
    where = f"{name}: frame {frame.index}"
    check_id(frame.name, f"{where}: name")
    for ref in (frame.image, frame.lidar, frame.depth):
        if ref is not None:
            check_path(ref.path, name=where)
    if frame.index < 0 or not 0 < frame.width <= _MOST_SIDE_PX or not 0 < frame.height <= _MOST_SIDE_PX:
        raise InputError(f"{where}: index must be 0 or more and the photo's sides 1 to {_MOST_SIDE_PX} px")
    if min(frame.intrinsics[:2]) <= 0:
        raise InputError(f"{where}: focal lengths must be positive px, found {frame.intrinsics[:2]}")
    for matrix in (frame.world_from_camera, frame.camera_from_lidar):
        if matrix is not None and [len(row) for row in matrix] != [4, 4, 4, 4]:
            raise InputError(f"{where}: poses must be 4 x 4 matrices")


def _check_track(key: str, track: Track, indices: set[int], name: str) -> None:
    where = f"{name}: track {key}"
    check_id(track.track_id, where)
    if key != track.track_id:
        raise InputError(f"{where}: stands under another id than its own, {track.track_id!r}")
    if track.car is not None:
        check_id(track.car.name, f"{where}: car")
    for frame, box in track.boxes.items():
        if frame not in indices:
            raise InputError(f"{where}: has a box in frame {frame}, which the scene does not have")
        _check_box(box, f"{where}, frame {frame}")


def _check_box(box: PlacedBox, where: str) -> None:
    if min(box.size) <= 0:
        raise InputError(f"{where}: size must be positive (length, height, width) in metres, found {box.size}")
    if abs(math.hypot(*box.rotation) - 1) > _UNIT:
        raise InputError(f"{where}: rotation must be a unit quaternion (w, x, y, z), found {box.rotation}")


def _check_numbers(value: Any, name: str) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            _check_numbers(item, f"{name}.{key}" if len(name) < 200 else name)
    elif isinstance(value, list):
        for item in value:
            _check_numbers(item, name)
    elif isinstance(value, float) and not abs(value) <= _MOST:  # NaN compares false
        raise InputError(f"{name}: numbers must be finite and below {_MOST:.0e}, found {value}")


def _plain(value: Any) -> Any:
    """Dataclasses, mappings and tuples as JSON values; sets as sorted lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted(value)
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
