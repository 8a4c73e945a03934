"""One record of the authors' json: its keys, checked, and the numbers they stand for.

Boxes are truncated to int with both ends included; `obj_*` is the centre of the BOTTOM face in KITTI's label frame.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from carstudio.dataset.sources.frame import Vector3
from carstudio.errors import InputError

_MAX_SIDE_PX = 1_000_000  # of a photograph; keeps the integer columns safe
_MAX_NUMBER = 1e9  # px or m: nothing that is measured in a photograph of cars is larger
_LEAST = 0.001  # px or m: a focal length or a side of a car below this is nonsense and would overflow
_MAX_PATH = 1024  # characters
REQUIRED = (
    "patch", "mask", "image_file", "fl_x", "fl_y", "cx", "cy", "cam_tx", "cam_ty", "cam_tz",
    "xmin", "ymin", "xmax", "ymax", "height", "width", "length", "obj_x", "obj_y", "obj_z", "yaw",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LegacyRecord:
    """What a record says, in the authors' conventions."""

    patch: str  # paths, relative to the json's folder
    mask: str
    image_file: str
    intrinsics: tuple[float, float, float, float]  # fl_x, fl_y, cx, cy: px of the whole photograph
    camera_translation: Vector3  # P2[:, 3]: px m, px m, m
    box2d: tuple[float, float, float, float]  # xmin, ymin, xmax, ymax px
    size: Vector3  # length, height, width, m
    bottom_center: Vector3  # obj_x, obj_y, obj_z, m
    yaw_rad: float
    frame_size: tuple[int, int] | None  # w, h px; None: not said


def parse_record(text: str) -> LegacyRecord:
    """The record of a JSON object; `InputError` names the key, what was expected and what was found."""
    constants: list[str] = []

    def constant(name: str) -> float:
        constants.append(name)
        return float(name)

    try:
        value = json.loads(text, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"expected a JSON object, found something else ({error})") from error
    if not isinstance(value, dict):
        raise InputError(f"expected an object with the keys {', '.join(REQUIRED)}, found {_shown(value)}")
    missing = [key for key in REQUIRED if key not in value]
    if missing:
        raise InputError(f"the keys {', '.join(missing)} are missing; only w, h and the distortion may be left out")
    record = _record(value)
    if constants:
        raise InputError(f"expected numbers as JSON knows them, found {constants[0]} under a key that is not used")
    return record


def _record(value: Mapping[str, Any]) -> LegacyRecord:
    fx, fy = (_number(value, key) for key in ("fl_x", "fl_y"))
    if min(fx, fy) < _LEAST:
        raise InputError(f"fl_x and fl_y must be at least {_LEAST}, in px, found ({fx}, {fy})")
    x0, y0, x1, y1 = (_number(value, key) for key in ("xmin", "ymin", "xmax", "ymax"))
    if x1 < x0 or y1 < y0:
        raise InputError(f"2-D box must have xmin <= xmax and ymin <= ymax in px, found {(x0, y0, x1, y1)}")
    length, height, width = (_number(value, key) for key in ("length", "height", "width"))
    if min(length, height, width) < _LEAST:
        raise InputError(f"length, height, width must be at least {_LEAST}, in metres, found {(length, height, width)}")
    tx, ty, tz = (_number(value, key) for key in ("cam_tx", "cam_ty", "cam_tz"))
    x, y, z = (_number(value, key) for key in ("obj_x", "obj_y", "obj_z"))
    return LegacyRecord(
        patch=_path(value, "patch"),
        mask=_path(value, "mask"),
        image_file=_path(value, "image_file"),
        intrinsics=(fx, fy, _number(value, "cx"), _number(value, "cy")),
        camera_translation=(tx, ty, tz),
        box2d=(x0, y0, x1, y1),
        size=(length, height, width),
        bottom_center=(x, y, z),
        yaw_rad=_number(value, "yaw"),
        frame_size=_frame_size(value),
    )


def _number(value: Mapping[str, Any], key: str) -> float:
    found = value[key]
    is_number = isinstance(found, (int, float)) and not isinstance(found, bool)
    if not is_number or not abs(found) <= _MAX_NUMBER:  # NaN compares as false
        raise InputError(f"{key} must be a finite number of at most {_MAX_NUMBER:.0e}, found {_shown(found)}")
    return float(found)


def _path(value: Mapping[str, Any], key: str) -> str:
    found = value[key]
    if not isinstance(found, str) or not 0 < len(found) <= _MAX_PATH or not _is_text(found):
        raise InputError(f"{key} must be a path of 1 to {_MAX_PATH} whole characters, found {_shown(found)}")
    return found


def _is_text(text: str) -> bool:
    """Half of a surrogate pair is JSON, but no file has such a name."""
    return "\0" not in text and not any("\ud800" <= character <= "\udfff" for character in text)


def _frame_size(value: Mapping[str, Any]) -> tuple[int, int] | None:
    if "w" not in value and "h" not in value:
        return None
    if "w" not in value or "h" not in value:
        raise InputError("expected both w and h or neither, found one of them")
    width, height = _number(value, "w"), _number(value, "h")
    if not all(1 <= side <= _MAX_SIDE_PX and side == int(side) for side in (width, height)):
        raise InputError(f"w and h must be whole numbers from 1 to {_MAX_SIDE_PX} px, found ({width}, {height})")
    return int(width), int(height)


def _shown(value: Any) -> str:
    """A value in a message: short, whatever was in the file."""
    text = ascii(value) if not isinstance(value, int) or abs(value) < 10**20 else "an integer of more than 20 digits"
    return text if len(text) <= 60 else f"{text[:60]}..."
