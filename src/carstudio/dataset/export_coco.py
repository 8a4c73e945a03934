"""`carstudio dataset export --format coco`: images/ and annotations.json as COCO's tools read them.

The pictures are the stored crops, so every position is in pixels of the crop, and each has one car. What COCO has no
field for (3-D box, camera, unknown pixels) stands under `carstudio`, with our names and units.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from carstudio.dataset.export_folder import ExportSummary, Which, export_folder, write_once
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.schema import JPEG_MAGIC
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.files import atomic_path
from carstudio.geometry.transforms import quaternion_from_rotation
from carstudio.images import decode_image
from carstudio.perception.rle import encode_rle
from carstudio.progress import Report, silent

ANNOTATIONS = "annotations.json"
CAR = {"id": 3, "name": "car", "supercategory": "vehicle"}  # COCO's own number of its cars
DESCRIPTION = (
    "CarPatch3D. Pictures are crops of photographs around one car each; all positions are in pixels of the crop. "
    "`segmentation` holds car pixels; `carstudio.unknown` those of which nobody knows (another object in front, "
    "outside the photograph): they are not background. 3-D boxes: centre (m, OpenCV camera axes), size length height "
    "width (m), rotation w x y z of camera_from_car."
)


def export_coco(store: PatchStore, out: Path, *, patches: Which = "kept", report: Report = silent) -> ExportSummary:
    """Write the store's patches below `out`, a new or empty folder; pictures are the stored bytes."""
    wanted = frozenset(store.patch_ids(kept=patches == "kept"))
    if not wanted:
        raise InputError(f"{store.path}: no patch can be exported, none is kept; --patches all takes rejected ones too")
    licences = {name: i for i, name in enumerate(sorted(store.info()["licences"]), start=1)}
    head = {
        "info": {"description": DESCRIPTION, "data_sha256": store.data_sha256},
        "licenses": [{"id": i, "name": name, "url": ""} for name, i in licences.items()],
        "categories": [CAR],
    }
    with export_folder(out), atomic_path(out / ANNOTATIONS) as partial, partial.open("w", encoding="utf-8") as file:
        file.write(json.dumps(head)[:-1])
        names = zip(store.light_records(), store.picture_names("image").to_pylist(), strict=True)
        light = ((record, name) for record, name in names if record.patch_id in wanted)
        _write_list(file, "images", (_image(i, *item, licences) for i, item in enumerate(light, start=1)))
        _write_list(file, "annotations", _annotations(store, wanted, out, report))
        file.write("}\n")
    return ExportSummary(out, {ANNOTATIONS: len(wanted)}, {})


def _write_list(file: TextIO, name: str, items: Iterator[dict[str, Any]]) -> None:
    """One after the other: those of half a million patches are never all in memory."""
    file.write(f', "{name}": [')
    for i, item in enumerate(items):
        file.write(",\n" if i else "\n")
        file.write(json.dumps(item, allow_nan=False))
    file.write("\n]")


def _image(number: int, record: PatchRecord, name: str, licences: dict[str, int]) -> dict[str, Any]:
    return {
        "id": number,
        "file_name": picture_name(record, is_jpeg=name.endswith(".jpg")),
        "width": record.crop_width,
        "height": record.crop_height,
        "license": licences[record.licence],
        "carstudio": {
            "patch_id": record.patch_id,
            "instance_id": record.instance_id,
            "source": record.source,
            "frame_path": record.frame_path,
            "crop": [record.crop_x0, record.crop_y0],
            "camera": {
                "fx": record.fx,
                "fy": record.fy,
                "cx": record.cx - record.crop_x0,
                "cy": record.cy - record.crop_y0,
                "source": record.camera_source,
            },
        },
    }


def picture_name(record: PatchRecord, *, is_jpeg: bool) -> str:
    """Name of a patch's picture in `images/`; ids are safe file names."""
    return f"{record.patch_id}.{'jpg' if is_jpeg else 'png'}"


def _annotations(store: PatchStore, wanted: frozenset[str], out: Path, report: Report) -> Iterator[dict[str, Any]]:
    number = 0
    for record in store.records():
        if record.patch_id not in wanted:
            continue
        number += 1
        name = picture_name(record, is_jpeg=record.image.startswith(JPEG_MAGIC))
        write_once(out, f"images/{name}", record.image)
        report("export", number, len(wanted), record.patch_id)
        yield annotation(number, record)


def annotation(number: int, record: PatchRecord) -> dict[str, Any]:
    """The car of patch `number`: box and mask in pixels of the crop; without a mask the box's area counts."""
    x0, x1 = (min(max(x - record.crop_x0, 0.0), float(record.crop_width)) for x in record.box2d[::2])
    y0, y1 = (min(max(y - record.crop_y0, 0.0), float(record.crop_height)) for y in record.box2d[1::2])
    ours: dict[str, Any] = {"box3d": _box3d(record), "score_2d": record.score_2d, "score_mask": record.score_mask}
    found = {
        "id": number,
        "image_id": number,
        "category_id": CAR["id"],
        "bbox": [x0, y0, x1 - x0, y1 - y0],
        "area": (x1 - x0) * (y1 - y0),
        "iscrowd": 0,
        "carstudio": ours,
    }
    if record.mask is None:
        return found
    mask = decode_image(record.mask, name=f"mask of patch {record.patch_id}", mode="L")
    is_car, is_unknown = mask == MaskValue.CAR, mask == MaskValue.UNKNOWN
    if is_unknown.any():
        ours["unknown"] = encode_rle(is_unknown)
    return found | {"segmentation": encode_rle(is_car), "area": int(is_car.sum())}


def _box3d(record: PatchRecord) -> dict[str, Any] | None:
    box = record.box
    if box is None:
        return None
    rotation = record.box_rotation or quaternion_from_rotation(box.rotation.double()).tolist()
    return {"center": record.box_center, "size": record.box_size, "rotation": rotation, "yaw": record.box_yaw}
