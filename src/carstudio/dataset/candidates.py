"""From a frame to patch records: crop, outline, occluders, mask, measured values."""

import hashlib
import json
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from carstudio.dataset.masks import masks_of_frame
from carstudio.dataset.outlines import crop_window, object_box
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.schema import check_id
from carstudio.dataset.soundness import value_problems
from carstudio.dataset.sources.frame import Frame, LabelledObject
from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.camera import Camera
from carstudio.geometry.overlap import box2d_iou
from carstudio.images import decode_image, encode_png
from carstudio.perception.results import MaskResult, PhotoSegmenter, Segmenter

Pixels = UInt8[np.ndarray, "frame_height frame_width 3"]


@dataclass(frozen=True)
class FrameResult:
    """Records of a frame or a few, and one sentence for each object that could not become one."""

    records: tuple[PatchRecord, ...]
    problems: tuple[str, ...] = ()
    num_items: int = 1  # frames (or records of another format) that it comes from


def records_of_frame(
    frame: Frame,
    segmenter: Segmenter | PhotoSegmenter,
    *,
    source: str,
    licence: str,
    types: tuple[str, ...],
    done: frozenset[str],
    pixels: Pixels | None = None,
) -> FrameResult:
    """Every object of the given types as a record, but those already `done`; a bad object costs only itself.

    `pixels` are the frame's, where they are decoded already.
    """
    pixels = decode_image(frame.image, name=frame.image_path) if pixels is None else pixels
    height, width = pixels.shape[:2]
    camera = Camera(torch.tensor(frame.intrinsics, dtype=torch.float64), width, height)
    wanted, problems = _wanted(frame, types, done)
    records = []
    for thing, result in zip(wanted, masks_of_frame(frame, pixels, camera, wanted, segmenter), strict=True):
        try:
            if isinstance(result, InputError):
                raise result
            records.append(_sound(_record(frame, thing, pixels, camera, result, source, frame.licence or licence)))
        except InputError as error:
            problems.append(f"{thing.patch_id[:120]}: {error}")
    return FrameResult(tuple(records), tuple(problems))


def _wanted(frame: Frame, types: tuple[str, ...], done: frozenset[str]) -> tuple[list[LabelledObject], list[str]]:
    """Objects that become records, and what is wrong with the frame and with those that cannot."""
    wanted, problems, seen = [], list(frame.problems), set[str]()
    for thing in frame.objects:
        if thing.type not in types:
            continue
        try:
            _check_ids(thing, seen)
        except InputError as error:
            problems.append(f"{thing.patch_id[:120]}: {error}")
            continue
        seen.add(thing.patch_id)
        if thing.patch_id not in done:
            wanted.append(thing)
    return wanted, problems


def _sound(record: PatchRecord) -> PatchRecord:
    for problem in value_problems(record):
        raise InputError(f"{problem}; correct the label or the calibration")
    return record


def _check_ids(thing: LabelledObject, seen: set[str]) -> None:
    """What the store would refuse in the middle of a build is a problem of the object alone."""
    check_id(thing.patch_id, "patch id")
    check_id(thing.instance_id, "instance id")
    if thing.patch_id in seen:
        raise InputError("the frame has this object twice (one frame, one track); the first is kept")


def _record(
    frame: Frame, thing: LabelledObject, pixels: Pixels, camera: Camera, result: MaskResult, source: str, licence: str
) -> PatchRecord:
    height, width = pixels.shape[:2]
    window = crop_window(thing.box2d, width, height)
    image = encode_png(np.ascontiguousarray(pixels[window.slices]))
    fx, fy, cx, cy = frame.intrinsics
    return PatchRecord(
        patch_id=thing.patch_id,
        instance_id=thing.instance_id,
        frame_id=frame.frame_id,
        sequence_id=frame.sequence_id,
        frame_index=frame.frame_index,
        source=source,
        image=image,
        mask=encode_png(mask_pixels(result)),
        frame_path=frame.image_path,
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
        camera_offset=frame.camera_offset,
        camera_source=frame.camera_source,
        box2d=thing.box2d,
        box_center=thing.box_center,
        box_size=thing.box_size,
        box_yaw=thing.box_yaw,
        box_rotation=thing.box_rotation,
        score_2d=thing.score_2d,
        score_mask=None if result.score is None else round(result.score, 6),
        score_3d=thing.score_3d,
        mask_ratio=float(result.car.mean()),
        box_iou=envelope_iou(object_box(thing), camera, thing.box2d),
        truncation=thing.truncation,
        occlusion=thing.occlusion,
        licence=licence,
        sha256=hashlib.sha256(image).hexdigest(),
        extra=json.dumps(thing.extra, sort_keys=True),
    )


def mask_pixels(result: MaskResult) -> UInt8[np.ndarray, "height width"]:
    """The store's mask: values of `MaskValue`."""
    mask = np.full(result.car.shape, MaskValue.BACKGROUND, np.uint8)
    mask[result.unknown] = MaskValue.UNKNOWN
    mask[result.car] = MaskValue.CAR
    return mask


def envelope_iou(box: Box3D | None, camera: Camera, box2d: tuple[float, float, float, float]) -> float | None:
    """IoU of a 2-D box with the envelope of the projected 3-D box, both in the photograph; None without a 3-D box."""
    if box is None:
        return None
    outline = envelope(box, camera)
    if outline is None:
        return 0.0
    iou = float(box2d_iou(outline, torch.tensor(box2d, dtype=torch.float64)))
    assert math.isfinite(iou)
    return round(iou, 6)
