"""CarPatch3D's columns as an Arrow schema, and rows to and from `PatchRecord`.

The columns are `PatchRecord`'s fields in their order. Images, masks and depth are `{bytes, path}` structs, and the
schema carries the feature description that makes Hugging Face `datasets` decode them as pictures.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, get_args

import pyarrow as pa

from carstudio.dataset.patch import PatchRecord
from carstudio.errors import InputError

PICTURES = ("image", "mask", "depth")  # columns that hold encoded pictures
TUPLES = {"camera_offset": 3, "box2d": 4, "box_center": 3, "box_size": 3, "box_rotation": 4}  # name -> its numbers
_INTEGERS = (
    "frame_index", "frame_width", "frame_height", "crop_x0", "crop_y0", "crop_width", "crop_height", "occlusion",
)  # fmt: skip
_FLOATS = (
    "fx", "fy", "cx", "cy", "box_yaw", "score_2d", "score_mask", "score_3d", "mask_ratio", "box_iou", "truncation",
)  # fmt: skip
SAFE_ID_PATTERN = r"\A[A-Za-z0-9](?:[A-Za-z0-9._-]{0,98}[A-Za-z0-9_-])?\z"  # in RE2's words, which Arrow speaks
_SAFE_ID = re.compile(SAFE_ID_PATTERN.replace(r"\z", r"\Z"))
JPEG_MAGIC = b"\xff\xd8"


def _arrow_type(name: str) -> pa.DataType:
    if name in PICTURES:
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    if name in TUPLES:
        return pa.list_(pa.float64())
    if name in _INTEGERS:
        return pa.int32()
    return pa.float64() if name in _FLOATS else pa.string()


def _hugging_face_feature(name: str) -> dict[str, Any]:
    if name in PICTURES:
        return {"_type": "Image"}
    if name in TUPLES:
        return {"feature": {"dtype": "float64", "_type": "Value"}, "_type": "Sequence"}
    return {"dtype": str(_arrow_type(name)).replace("double", "float64"), "_type": "Value"}


COLUMNS = tuple(field.name for field in fields(PatchRecord))
REQUIRED = tuple(field.name for field in fields(PatchRecord) if type(None) not in get_args(field.type))
LIGHT_COLUMNS = tuple(name for name in COLUMNS if name not in PICTURES)
SCHEMA = pa.schema(
    [pa.field(name, _arrow_type(name)) for name in COLUMNS],  # nullable: `datasets` takes no picture from others
    metadata={
        "huggingface": json.dumps({"info": {"features": {name: _hugging_face_feature(name) for name in COLUMNS}}})
    },
)


def check_id(value: str, what: str) -> str:
    """`value` when it may serve as a file name on every system; `InputError` otherwise."""
    if not _SAFE_ID.match(value):
        raise InputError(
            f"{what} {value!r}: expected 1 to 100 letters, digits, '.', '_' or '-', no mark first, no dot last"
        )
    return value


def _picture_cell(data: bytes | None, patch_id: str) -> dict[str, Any] | None:
    if data is None:
        return None
    suffix = "jpg" if data.startswith(JPEG_MAGIC) else "png"
    return {"bytes": data, "path": f"{patch_id}.{suffix}"}


def table_from_records(records: Sequence[PatchRecord]) -> pa.Table:
    """Rows in the order given."""
    columns: dict[str, list[Any]] = {}
    for name in COLUMNS:
        values = [getattr(record, name) for record in records]
        if name in PICTURES:
            values = [_picture_cell(data, record.patch_id) for data, record in zip(values, records, strict=True)]
        columns[name] = values
    return pa.table(columns, schema=SCHEMA)


def record_from_row(row: Mapping[str, Any]) -> PatchRecord:
    """The record of one row as `pyarrow` gives it (`table.to_pylist()`); pictures may be left out of the row.

    `InputError` names the patch and the column where a value is missing, or has not the numbers it must have.
    """
    values: dict[str, Any] = {"image": b""}
    for name in COLUMNS if "image" in row else LIGHT_COLUMNS:
        value = row[name]
        if value is None and name in REQUIRED:
            raise InputError(f"patch {row['patch_id']!r}: {name} must have a value, found none; restore the store")
        if value is not None:
            if name in PICTURES:
                value = _picture_bytes(value, name, row)
            elif name in TUPLES:
                value = _numbers(value, name, row)
        values[name] = value
    return PatchRecord(**values)


def _picture_bytes(value: Mapping[str, Any], name: str, row: Mapping[str, Any]) -> bytes:
    data: bytes | None = value["bytes"]
    if data is None:
        raise InputError(
            f"patch {row['patch_id']!r}: {name} must hold a picture's bytes, found none; restore the store"
        )
    return data


def _numbers(value: Sequence[Any], name: str, row: Mapping[str, Any]) -> tuple[float, ...]:
    if len(value) != TUPLES[name] or None in value:
        raise InputError(
            f"patch {row['patch_id']!r}: {name} must be {TUPLES[name]} numbers, found {value}; restore the store"
        )
    return tuple(value)
