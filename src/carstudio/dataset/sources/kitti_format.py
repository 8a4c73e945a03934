"""KITTI's text files: object labels (15 or 16 columns), tracking labels (17 or 18) and calibration.

Label columns: type, truncation, occlusion, alpha, 2-D box (x0 y0 x1 y1 px), height width length (m), centre of the
BOTTOM face (x y z, m, rectified camera frame), rotation_y (rad) and, in results, a score. Tracking labels put the frame
number and the track id in front. Described in the KITTI devkits' readme files.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from carstudio.dataset.sources.frame import CameraOffset, Vector3
from carstudio.errors import InputError
from carstudio.geometry.box3d import box_from_kitti
from carstudio.geometry.camera import camera_offset_from_projection

KITTI_LICENCE = "CC-BY-NC-SA-3.0 (KITTI)"
DONT_CARE = "DontCare"
_FIELDS = (
    "truncation", "occlusion", "alpha", "x0", "y0", "x1", "y1", "height", "width", "length", "x", "y", "z",
    "rotation_y", "score",
)  # fmt: skip
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)  # `float` takes 1_0 and others' digits
_WHOLE = re.compile(r"-?\d{1,9}", re.ASCII)  # frames and tracks fit 32 bits
_MOST = 1e6  # of any number in a label or calibration (px, m, rad, px m): a thousand kilometres
_LEAST_FOCAL_PX = 1.0  # shorter focal lengths are in metres or millimetres
_NOISE = 1e-6  # of entries of a projection that must be 0 or 1; KITTI's files have exactly these
_OCCLUSION_UNKNOWN = 3  # the devkit: 0 visible, 1 partly, 2 largely occluded, 3 unknown


@dataclass(frozen=True)
class KittiLabel:
    """One line of a label file. `size` and `bottom_center` are None where the line gives no 3-D box (-1, -1000)."""

    type: str
    truncation: float | None  # detection: 0 to 1; tracking: level 0, 1, 2
    occlusion: int | None  # 0 visible, 1 partly, 2 largely
    box2d: tuple[float, float, float, float]
    size: Vector3 | None  # length, height, width, m
    bottom_center: Vector3 | None  # m, label frame
    yaw_rad: float
    score: float | None
    line: str  # verbatim


@dataclass(frozen=True)
class KittiCalibration:
    """Camera 2: intrinsics in px and K^-1 P2[:, 3] in metres."""

    intrinsics: tuple[float, float, float, float]
    camera_offset: Vector3


def parse_label(line: str, *, where: str) -> KittiLabel:
    """One object of a label file (without the tracking columns); `where` names file and line in messages."""
    words = line.split()
    if len(words) not in (len(_FIELDS), len(_FIELDS) + 1):
        raise InputError(f"{where}: expected 15 columns (16 with a score) from the type on, found {len(words)}")
    values = {name: _number(word, name, where) for name, word in zip(_FIELDS, words[1:], strict=False)}
    size = (values["length"], values["height"], values["width"])
    bottom_center = (values["x"], values["y"], values["z"])
    box2d = (values["x0"], values["y0"], values["x1"], values["y1"])
    if box2d[2] <= box2d[0] or box2d[3] <= box2d[1]:
        raise InputError(f"{where}: 2-D box must have x0 < x1 and y0 < y1 in px, found {box2d}")
    has_box3d = not (size in ((-1.0, -1.0, -1.0), (-1000.0, -1000.0, -1000.0)) and min(bottom_center) <= -10)
    if has_box3d and words[0] != DONT_CARE and min(size) <= 0:
        raise InputError(f"{where}: box size must be positive (length, height, width) in metres, found {size}")
    has_box3d = has_box3d and words[0] != DONT_CARE
    return KittiLabel(
        type=words[0],
        truncation=values["truncation"] if values["truncation"] >= 0 else None,
        occlusion=int(values["occlusion"]) if 0 <= values["occlusion"] < _OCCLUSION_UNKNOWN else None,
        box2d=box2d,
        size=size if has_box3d else None,
        bottom_center=bottom_center if has_box3d else None,
        yaw_rad=values["rotation_y"],
        score=values.get("score"),
        line=line.strip(),
    )


def _number(word: str, name: str, where: str) -> float:
    value = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {name} must be a finite number, found {word[:40]!r}")
    if abs(value) > _MOST:
        raise InputError(f"{where}: {name} must lie between -{_MOST:.0e} and {_MOST:.0e}, found {word[:40]!r}")
    return value


def parse_labels(text: str, *, name: str) -> list[KittiLabel]:
    """All objects of a detection label file; empty lines are skipped."""
    lines = enumerate(text.split("\n"), start=1)  # as editors count; `splitlines` would also cut at rarer marks
    return [parse_label(line, where=f"{name} line {number}") for number, line in lines if line.strip()]


@dataclass(frozen=True)
class TrackingLine:
    """A tracking label before its object is parsed, so that a broken line costs only its frame."""

    track_id: int
    rest: str  # the line from the type on
    where: str


def group_tracking_lines(text: str, *, name: str) -> tuple[dict[int, list[TrackingLine]], tuple[str, ...]]:
    """Lines by frame number, and one sentence for each line whose frame or track cannot be read."""
    frames: dict[int, list[TrackingLine]] = {}
    problems = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        where = f"{name} line {number}"
        words = line.split(maxsplit=2)
        if len(words) < 3 or not all(_WHOLE.fullmatch(word) for word in words[:2]):
            problems.append(f"{where}: expected 'frame track type ...', found {line.strip()[:60]!r}; line skipped")
        elif words[1].startswith("-") and words[2].split()[0] != DONT_CARE:
            problems.append(f"{where}: track must be 0 or more (-1 is for {DONT_CARE}), found {words[1]}; line skipped")
        else:
            frames.setdefault(int(words[0]), []).append(TrackingLine(int(words[1]), words[2], where))
    return frames, tuple(problems)


def parse_calibration(
    text: str, *, name: str, key: str = "P2", camera_offset: CameraOffset = "exact"
) -> KittiCalibration:
    """Camera `key` of a calibration file; keys with or without a colon (the tracking files mix both)."""
    for number, line in enumerate(text.split("\n"), start=1):
        words, where = line.split(), f"{name} line {number}"
        if words and words[0].rstrip(":") == key:
            numbers = [_number(word, f"number {i} of {key}", where) for i, word in enumerate(words[1:], start=1)]
            calibration = _calibration(numbers, where, key)
            return calibration if camera_offset == "exact" else replace(calibration, camera_offset=(0.0, 0.0, 0.0))
    raise InputError(f"{name}: no line {key}; expected a KITTI calibration file with P0 to P3")


def _calibration(values: Sequence[float], name: str, key: str) -> KittiCalibration:
    if len(values) != 12:
        raise InputError(f"{name}: {key} must have 12 numbers (3 x 4, row by row), found {len(values)}")
    projection = torch.tensor(values, dtype=torch.float64).reshape(3, 4)
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if fx <= 0 or fy <= 0:
        raise InputError(f"{name}: {key} must have positive focal lengths, found ({fx}, {fy}) px")
    pinhole = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    if float((projection[:, :3] - pinhole).abs().max()) > _NOISE:  # skew or a turn would be dropped without a word
        raise InputError(
            f"{name}: {key} must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
            f"{' '.join(f'{value:g}' for value in values)}"
        )
    if min(fx, fy) < _LEAST_FOCAL_PX:
        raise InputError(f"{name}: {key} must have focal lengths in px (hundreds), found ({fx}, {fy})")
    x, y, z = camera_offset_from_projection(projection).tolist()
    return KittiCalibration((fx, fy, cx, cy), (x, y, z))


def center_in_camera(label: KittiLabel, camera_offset: Vector3) -> Vector3 | None:
    """Centre of the label's box in the camera frame (offset applied), in float64."""
    if label.bottom_center is None or label.size is None:
        return None
    bottom, size, offset = (
        torch.tensor(values, dtype=torch.float64) for values in (label.bottom_center, label.size, camera_offset)
    )
    yaw = torch.tensor(label.yaw_rad, dtype=torch.float64)
    x, y, z = box_from_kitti(bottom, size, yaw, offset).center.tolist()
    return x, y, z


def read_text(path: Path, what: str) -> str:
    """Text of a KITTI file; `InputError` names what is missing."""
    try:
        return path.read_text(encoding="utf-8-sig")  # Windows editors put a mark in front that would hide the first key
    except OSError as error:
        raise InputError(f"{path}: {what} cannot be read ({error.strerror}); restore it") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected {what} as UTF-8 text, found binary data; restore it") from error


def find_layout(root: Path, images: str, example: str) -> Path:
    """The folder that holds `images`: `root` itself or `root/training`."""
    for folder in (root, root / "training"):
        if (folder / images).is_dir():
            return folder
    raise InputError(f"{root}: no folder {images}/ or training/{images}/; expected KITTI's layout ({example})")
