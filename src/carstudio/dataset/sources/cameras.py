"""Which camera took a photograph: from EXIF, from a calibration, given, or as rough as in the paper.

A camera spec is `exif`, `paper`, `FOCAL_PX`, `FX,FY,CX,CY` or `calib:PATH`. What was chosen and where it comes from is
stored with every patch (`camera_source`).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from carstudio.dataset.sources.frame import CameraOffset, Vector3
from carstudio.dataset.sources.kitti_format import parse_calibration, read_text
from carstudio.errors import InputError
from carstudio.files import inside
from carstudio.images import ExifLens, image_size, read_exif_lens

KITTI_FOCAL_PX, KITTI_WIDTH_PX = 721.5377, 1242.0  # of camera 2: a field of view of 81.4 degrees
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
LEAST_VIEW_DEG, MOST_VIEW_DEG = 2.0, 150.0  # of the photograph's longer side; EXIF that says else is wrong
CAMERA_SPECS = ("exif", "paper", "FOCAL_PX", "FX,FY,CX,CY", "calib:PATH")
_NUMBERS = re.compile(r"[0-9.]+(?:,[0-9.]+){0,3}")

Intrinsics = tuple[float, float, float, float]


@dataclass(frozen=True)
class FrameCamera:
    """Intrinsics (fx, fy, cx, cy px of the upright photograph, pixel centres at +0.5) and where they come from."""

    intrinsics: Intrinsics
    source: str  # exif:35mm, exif:focal-plane, assumed:kitti-fov, paper, given or calib:P2
    offset: Vector3 = (0.0, 0.0, 0.0)  # m; X_camera = X_label_frame + offset


@dataclass(frozen=True)
class CameraSpec:
    """A parsed camera spec."""

    kind: str  # exif, paper, given or calib
    numbers: tuple[float, ...] = ()  # given: focal length, or fx, fy, cx, cy
    path: Path | None = None  # calib: a KITTI calibration file, or the folder that has one for each photograph
    camera_offset: CameraOffset = "exact"

    def of(self, image: bytes, *, path: str, frame_id: str) -> FrameCamera:
        """The camera of one encoded photograph; `path` is relative to the source's root."""
        if self.kind == "calib":
            return self._calibrated(path, frame_id)
        width, height = image_size(image, name=path)
        if len(self.numbers) == 4:
            fx, fy, cx, cy = self.numbers
            return FrameCamera((fx, fy, cx, cy), "given")
        focal, source = self._focal(image, width, height, path)
        return FrameCamera((focal, focal, width / 2, height / 2), source)

    def _focal(self, image: bytes, width: int, height: int, path: str) -> tuple[float, str]:
        if self.kind == "paper":
            return KITTI_FOCAL_PX, "paper"
        if self.kind == "given":
            return self.numbers[0], "given"
        return focal_from_exif(read_exif_lens(image, name=path), width, height) or (
            KITTI_FOCAL_PX * max(width, height) / KITTI_WIDTH_PX,
            "assumed:kitti-fov",
        )

    def _calibrated(self, path: str, frame_id: str) -> FrameCamera:
        assert self.path is not None, "a calib spec has a path"
        file = self.path if self.path.is_file() else beside(self.path, path, frame_id, ".txt")
        if file is None:
            raise InputError(
                f"{self.path}: no calibration {PurePosixPath(path).with_suffix('.txt')} of this photograph"
            )
        found = parse_calibration(read_text(file, "calibration"), name=file.name, camera_offset=self.camera_offset)
        return FrameCamera(found.intrinsics, "calib:P2", found.camera_offset)


def parse_camera(text: str, camera_offset: CameraOffset = "exact") -> CameraSpec:
    """The camera spec of a command line; `InputError` says what else there is."""
    if text in ("exif", "paper"):
        return CameraSpec(text)
    kind, _, argument = text.partition(":")
    if kind == "calib" and argument:
        if not Path(argument).exists():
            raise InputError(f"--camera {text}: no such file or folder; expected KITTI calibrations (FRAME.txt)")
        return CameraSpec("calib", path=Path(argument), camera_offset=camera_offset)
    if _NUMBERS.fullmatch(text):
        try:
            numbers = tuple(float(word) for word in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) in (1, 4) and min(numbers) > 0 and all(map(math.isfinite, numbers)):
            return CameraSpec("given", numbers)
    raise InputError(f"--camera {text!r}: expected one of {', '.join(CAMERA_SPECS)} (numbers in px, above 0)")


def focal_from_exif(lens: ExifLens, width: int, height: int) -> tuple[float, str] | None:
    """(focal length in px, source) of a photograph of this size; None where EXIF does not tell it, or not credibly.

    A crop keeps the camera's EXIF but not its field of view: it is known by its sides, which are no longer in the
    ratio that EXIF has for them.
    """
    if lens.pixels is not None:
        long, short = max(lens.pixels), min(lens.pixels)
        if abs(max(width, height) * short - min(width, height) * long) > 0.02 * long * max(width, height):
            return None
    ways: tuple[tuple[str, Callable[[], float | None]], ...] = (
        ("exif:35mm", lambda: _by_35mm(lens, width, height)),
        ("exif:focal-plane", lambda: _by_focal_plane(lens, width, height)),
    )
    for source, way in ways:
        focal = way()
        if focal is None:
            continue
        view_deg = math.degrees(2 * math.atan(max(width, height) / 2 / focal))
        if LEAST_VIEW_DEG <= view_deg <= MOST_VIEW_DEG:
            return focal, source
    return None


def _by_35mm(lens: ExifLens, width: int, height: int) -> float | None:
    """The focal length that gives the same diagonal field of view on 36 x 24 mm film (CIPA DCG-001)."""
    if lens.focal_35mm is None:
        return None
    return lens.focal_35mm * math.hypot(width, height) / FILM_DIAGONAL_MM


def _by_focal_plane(lens: ExifLens, width: int, height: int) -> float | None:
    """Focal length times the sensor's pixels per mm, scaled if the photograph was."""
    if lens.focal_mm is None or lens.plane_px_per_mm is None or lens.pixels is None:
        return None
    return lens.focal_mm * lens.plane_px_per_mm * max(width, height) / max(lens.pixels)


def beside(folder: Path, path: str, frame_id: str, suffix: str) -> Path | None:
    """The file that belongs to a photograph: the same relative path with another suffix, or its frame id."""
    for name in (str(PurePosixPath(path).with_suffix(suffix)), f"{frame_id}{suffix}"):
        file = inside(folder, name)
        if file.is_file():
            return file
    return None
