"""What the values of a record must be for anything to be computed from them, whoever wrote the store."""

import math
from collections.abc import Iterator

from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.schema import TUPLES, check_id
from carstudio.errors import InputError
from carstudio.files import parse_json

MOST = 1e9  # of any number in a record (px, m, rad): far beyond a photograph's, and safe to square in 32 bits
_NUMBERS = (
    "fx", "fy", "cx", "cy", "box_yaw", "score_2d", "score_mask", "score_3d", "mask_ratio", "box_iou", "truncation",
)  # fmt: skip


def value_problems(record: PatchRecord) -> Iterator[str]:
    """One sentence for everything wrong with ids, camera, boxes and `extra`; pictures are not looked at."""
    yield from _id_problems(record)
    yield from _number_problems(record)
    if not min(record.fx, record.fy) > 0:
        yield f"focal length ({record.fx}, {record.fy}) px is not positive"
    if min(record.crop_width, record.crop_height) <= 0:
        yield f"crop of {record.crop_width} x {record.crop_height} px is empty"
    if record.frame_width is not None and record.frame_width <= 0:
        yield f"frame_width {record.frame_width} px is not positive"
    if record.frame_height is not None and record.frame_height <= 0:
        yield f"frame_height {record.frame_height} px is not positive"
    yield from _box_problems(record)
    yield from _extra_problems(record)


def _id_problems(record: PatchRecord) -> Iterator[str]:
    for name, value in (("patch id", record.patch_id), ("instance id", record.instance_id)):
        try:
            check_id(value, name)
        except InputError as error:
            yield str(error)


def _number_problems(record: PatchRecord) -> Iterator[str]:
    for name in (*_NUMBERS, *TUPLES):
        value = getattr(record, name)
        numbers = (() if value is None else value) if name in TUPLES else (0.0 if value is None else value,)
        if not all(map(math.isfinite, numbers)):
            yield f"{name} {value} is not finite"
        elif any(abs(number) > MOST for number in numbers):
            yield f"{name} {value} is beyond {MOST:.0e}"


def _box_problems(record: PatchRecord) -> Iterator[str]:
    if (record.box_center is None) != (record.box_size is None):
        yield f"box_center {record.box_center} and box_size {record.box_size} must both be there, or neither"
    if record.box_center is not None and record.box_yaw is None and record.box_rotation is None:
        yield "a 3-D box needs box_yaw or box_rotation, found neither"
    if record.box_size is not None and not min(record.box_size) > 0:
        yield f"box_size {record.box_size} is not positive"
    if record.box_rotation is not None and not 0.9 < math.hypot(*record.box_rotation) < 1.1:
        yield f"box_rotation {record.box_rotation} is no unit quaternion"


def _extra_problems(record: PatchRecord) -> Iterator[str]:
    try:
        is_object = isinstance(parse_json(record.extra, name="extra"), dict)
    except InputError as error:
        yield str(error)
        return
    if not is_object:
        yield f"extra must be a JSON object, found {record.extra[:60]!r}"
