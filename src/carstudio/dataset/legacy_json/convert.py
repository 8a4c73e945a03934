"""A record of the authors' json with its patch and mask -> a row of the store."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

from carstudio.dataset.candidates import envelope_iou
from carstudio.dataset.legacy_json.fields import LegacyRecord, parse_record
from carstudio.dataset.legacy_json.names import DATASET_NAMES, LICENCES, Identity
from carstudio.dataset.legacy_json.stream import RawInstance
from carstudio.dataset.legacy_json.verbatim import Verbatim, pack_extra
from carstudio.dataset.outlines import crop_window
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.sources.frame import CameraOffset, Vector3
from carstudio.errors import InputError
from carstudio.files import inside
from carstudio.geometry.box3d import Box3D, box_from_kitti
from carstudio.geometry.camera import Camera, camera_offset_from_projection
from carstudio.images import decode_image, encode_png, image_size
from carstudio.perception.results import Window

MAX_PICTURE_BYTES = 64 * 2**20  # of one patch or mask; the authors' have some 50 kB
UNBOUNDED_PX = 2**31 - 1  # a photograph of unknown size cuts no box off on the right and below
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_DEPTH_AND_COLOUR = slice(24, 26)  # these bytes of a PNG file (ISO 15948, IHDR)


def patch_record(
    folder: Path, raw: RawInstance, *, json: str, dataset_name: str, identity: Identity, camera_offset: CameraOffset
) -> PatchRecord:
    """The row of one record, with its text in `extra`; `InputError` says what is wrong with the record."""
    record = parse_record(raw.text)
    window = record_window(record)
    image = _read_picture(folder, record.patch, window)
    decode_image(image, name=record.patch)  # a broken patch must not wait for the training to be found
    mask_file = _read_picture(folder, record.mask, window)
    mask, is_car = store_mask(mask_file, name=record.mask)
    offset = record_offset(record) if camera_offset == "exact" else (0.0, 0.0, 0.0)
    box = record_box(record, offset)
    width, height = record.frame_size or (None, None)
    fx, fy, cx, cy = record.intrinsics
    x, y, z = box.center.tolist()
    verbatim = Verbatim(
        json=json,
        dataset_name=dataset_name,
        index=raw.index,
        before=raw.before,
        after=raw.after,
        text=raw.text,
        mask_png=None if mask is mask_file else mask_file,
    )
    return PatchRecord(
        patch_id=identity.patch_id,
        instance_id=identity.instance_id,
        frame_id=identity.frame_id,
        sequence_id=identity.sequence_id,
        frame_index=identity.frame_index,
        source="legacy-json",
        image=image,
        mask=mask,
        frame_path=record.image_file,
        frame_width=width,
        frame_height=height,
        crop_x0=window.x0,
        crop_y0=window.y0,
        crop_width=window.width,
        crop_height=window.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        camera_offset=offset,
        camera_source="legacy-json",
        box2d=record.box2d,
        box_center=(x, y, z),
        box_size=record.size,
        box_yaw=record.yaw_rad,
        mask_ratio=float(is_car.mean()),
        box_iou=_box_iou(record, box),
        licence=LICENCES[DATASET_NAMES[dataset_name]],
        sha256=hashlib.sha256(image).hexdigest(),
        extra=pack_extra(verbatim),
    )


def record_window(record: LegacyRecord) -> Window:
    """The crop in whole pixels: truncated to int, both ends included, clipped to the photograph where it is known."""
    if min(record.box2d[2:]) < 0:
        raise InputError(f"2-D box {record.box2d} lies left of or above the photograph")
    return crop_window(record.box2d, *(record.frame_size or (UNBOUNDED_PX, UNBOUNDED_PX)))


def record_offset(record: LegacyRecord) -> Vector3:
    """K^-1 (cam_tx, cam_ty, cam_tz): metres from the label frame to the camera."""
    fx, fy, cx, cy = record.intrinsics
    tx, ty, tz = record.camera_translation
    projection = torch.tensor([[fx, 0, cx, tx], [0, fy, cy, ty], [0, 0, 1, tz]], dtype=torch.float64)
    x, y, z = camera_offset_from_projection(projection).tolist()
    return x, y, z


def record_box(record: LegacyRecord, offset: Vector3) -> Box3D:
    """The 3-D box in the camera frame, float64."""
    values = (record.bottom_center, record.size, record.yaw_rad, offset)
    bottom, size, yaw, shift = (torch.tensor(value, dtype=torch.float64) for value in values)
    return box_from_kitti(bottom, size, yaw, shift)


def _box_iou(record: LegacyRecord, box: Box3D) -> float | None:
    """Unknown where the photograph's size is: it decides how much of the envelope was cut off."""
    if record.frame_size is None:
        return None
    camera = Camera(torch.tensor(record.intrinsics, dtype=torch.float64), *record.frame_size)
    return envelope_iou(box, camera, record.box2d)


def _read_picture(folder: Path, name: str, window: Window) -> bytes:
    """Bytes of a patch or mask that has the size of its box."""
    try:
        path = inside(folder, name)
        if not path.is_file():
            raise InputError(f"{name}: no such file below {folder}")
        if path.stat().st_size > MAX_PICTURE_BYTES:
            raise InputError(f"{name}: {path.stat().st_size} bytes, at most {MAX_PICTURE_BYTES} are read")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    except RuntimeError as error:  # links that go round in a circle
        raise InputError(f"{name}: cannot be read (a link that leads to itself)") from error
    size = image_size(data, name=name)
    if size != (window.width, window.height):
        raise InputError(
            f"{name} is {size[0]} x {size[1]} px; expected {window.width} x {window.height} px, xmin to xmax and ymin "
            "to ymax truncated to int, both ends included"
        )
    return data


def store_mask(data: bytes, *, name: str) -> tuple[bytes, Bool[np.ndarray, "height width"]]:
    """The store's mask of one of the authors', and where it is car: any value that is not zero.

    Their very bytes where they are such a mask already: one channel, 0 and 255.
    """
    found = png_format(data)
    if found is not None and found[0] > 8:
        raise InputError(f"{name}: expected a mask of 8 bits per channel, found {found[0]}")
    is_grey = found == (8, 0)
    pixels = decode_image(data, name=name, mode="L" if is_grey else "RGB")
    is_car = pixels != 0 if is_grey else np.any(pixels, axis=-1)
    mask = np.where(is_car, MaskValue.CAR, MaskValue.BACKGROUND).astype(np.uint8)
    return (data if is_grey and np.array_equal(pixels, mask) else encode_png(mask)), is_car


def png_format(data: bytes) -> tuple[int, int] | None:
    """(bits per channel, colour type: 0 grey, 2 RGB) of a PNG file; None for other files."""
    if not data.startswith(_PNG_MAGIC) or len(data) < _PNG_DEPTH_AND_COLOUR.stop:
        return None
    depth, colour = data[_PNG_DEPTH_AND_COLOUR]
    return depth, colour
