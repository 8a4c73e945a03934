"""A patch of any other source as a record of the authors' json: the conversion of the import, backwards.

Their format knows less: no depth, one mask value (unknown pixels become background), no box but an upright one.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from carstudio.dataset.legacy_json.convert import UNBOUNDED_PX, png_format
from carstudio.dataset.legacy_json.names import DATASET_NAMES, name_patch
from carstudio.dataset.outlines import crop_window
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.errors import InputError
from carstudio.images import decode_image, encode_png
from carstudio.perception.results import Window

_UPRIGHT = 1e-6  # x and z of a unit quaternion: a tilt of 1e-4 degrees moves no pixel
_MOST_NAMES = 1_000_000  # six digits


@dataclass
class Namer:
    """Gives patches the authors' file names, numbering patches and cars as they come."""

    running: int = 0
    cars: dict[str, int] = field(default_factory=dict)

    def name(self, record: PatchRecord) -> tuple[str, str]:
        """(subset, stem)."""
        car = self.cars.setdefault(record.instance_id, len(self.cars))
        if max(self.running, car) >= _MOST_NAMES:
            raise InputError(f"the authors' file names have room for {_MOST_NAMES} patches; export fewer")
        name = name_patch(record.patch_id, self.running, car)
        self.running += name[0] == "dv"
        return name


def obstacle(record: PatchRecord) -> str | None:
    """Why a patch cannot be said in the authors' format; None when it can."""
    if record.mask is None:
        return "no mask"
    if record.box_center is None or record.box_size is None:
        return "no 3-D box"
    if record.box_rotation is not None and max(abs(record.box_rotation[1]), abs(record.box_rotation[3])) > _UPRIGHT:
        return "box not upright: the format knows only its yaw"
    window = _window(record)
    right, bottom = window.x0 + window.width, window.y0 + window.height
    limits = (record.frame_width or right, record.frame_height or bottom)
    if min(window.x0, window.y0) < 0 or right > limits[0] or bottom > limits[1]:
        return "crop sticks out of the photograph"
    return None


def made_record(record: PatchRecord, stem: str) -> dict[str, Any]:
    """The keys of the authors' json in their order."""
    assert record.box_center is not None
    assert record.box_size is not None
    x0, y0, x1, y1 = _box2d(record)
    length, height, width = record.box_size
    shift_x, shift_y, shift_z = record.camera_offset
    x, y, z = record.box_center
    value: dict[str, Any] = {
        "patch": f"patch/{stem}_patch.png",
        "mask": f"mask/{stem}_mask.png",
        "image_file": record.frame_path,
        "fl_x": record.fx,
        "fl_y": record.fy,
        "cx": record.cx,
        "cy": record.cy,
        "cam_tx": record.fx * shift_x + record.cx * shift_z,
        "cam_ty": record.fy * shift_y + record.cy * shift_z,
        "cam_tz": shift_z,
        "xmin": x0,
        "ymin": y0,
        "xmax": x1,
        "ymax": y1,
        "height": height,
        "width": width,
        "length": length,
        "obj_x": x - shift_x,
        "obj_y": y - shift_y + height / 2,
        "obj_z": z - shift_z,
        "yaw": _yaw(record),
    }
    if record.frame_width is not None and record.frame_height is not None:
        value |= {"w": record.frame_width, "h": record.frame_height}
    return value


def _window(record: PatchRecord) -> Window:
    return Window(record.crop_x0, record.crop_y0, record.crop_width, record.crop_height)


def _box2d(record: PatchRecord) -> tuple[float, float, float, float]:
    """The 2-D box where truncating it gives the crop, else the crop's first and last pixels."""
    window = _window(record)
    try:
        frame = (record.frame_width or UNBOUNDED_PX, record.frame_height or UNBOUNDED_PX)
        if crop_window(record.box2d, *frame) == window:
            return record.box2d
    except InputError:  # the 2-D box lies outside the photograph
        pass
    x1, y1 = window.x0 + window.width - 1, window.y0 + window.height - 1
    return float(window.x0), float(window.y0), float(x1), float(y1)


def _yaw(record: PatchRecord) -> float:
    if record.box_yaw is not None:
        return record.box_yaw
    assert record.box_rotation is not None, "a box has a yaw or a rotation"
    w, _, y, _ = record.box_rotation
    return math.remainder(2 * math.atan2(y, w), 2 * math.pi)


def made_picture(record: PatchRecord) -> bytes:
    """The patch as 8-bit RGB PNG: the stored bytes where they are that, else the same pixels."""
    if png_format(record.image) == (8, 2) and b"eXIf" not in record.image:  # the authors' readers turn nothing upright
        return record.image
    return encode_png(decode_image(record.image, name=f"image of patch {record.patch_id}"))


def made_mask(record: PatchRecord) -> bytes:
    """255 where the car is, 0 elsewhere: any other value would be car to the authors' readers."""
    assert record.mask is not None
    mask = decode_image(record.mask, name=f"mask of patch {record.patch_id}", mode="L")
    is_car = mask == MaskValue.CAR
    if png_format(record.mask) == (8, 0) and not (mask[~is_car]).any():
        return record.mask
    return encode_png(np.where(is_car, MaskValue.CAR, MaskValue.BACKGROUND).astype(np.uint8))


def dataset_name(subset: str) -> str:
    """The authors' name of a subset."""
    return next(name for name, value in DATASET_NAMES.items() if value == subset)
