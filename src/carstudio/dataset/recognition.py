"""Who is in a photograph: 2-D boxes by a detector, 3-D boxes joined to them, in place of a source's labels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import UInt8

from carstudio.dataset.sources.frame import Frame, LabelledObject
from carstudio.errors import InputError
from carstudio.geometry.overlap import box2d_iou
from carstudio.perception.results import (
    BoxEstimator,
    Detection2D,
    Detection3D,
    Detector,
    Photo,
    PhotoSegmenter,
    Segmenter,
)

SAME_CAR_IOU = 0.5  # of a detection and the 2-D box of a 3-D box: PASCAL's match

Pixels = UInt8[np.ndarray, "_ _ 3"]  # of photographs of different sizes


@dataclass(frozen=True)
class Perception:
    """The components of a build."""

    segmenter: Segmenter | PhotoSegmenter
    detector: Detector | None = None  # None: the labelled 2-D boxes
    boxes: BoxEstimator | None = None  # None: the labelled 3-D boxes, or none
    uses_label_boxes: bool = True


def recognise(frames: Sequence[Frame], pixels: Sequence[Pixels], perception: Perception) -> list[Frame]:
    """The frames with their objects as `perception` sees them; what cannot be had is told in their `problems`."""
    if perception.detector is None and perception.boxes is None and perception.uses_label_boxes:
        return list(frames)
    photos = [as_photo(frame, image) for frame, image in zip(frames, pixels, strict=True)]
    found: Sequence[list[Detection2D] | None] = [None] * len(photos)
    if perception.detector is not None:
        found = perception.detector.detect(photos)
    return [
        _with_boxes(_with_objects(frame, detections), photo, perception)
        for frame, photo, detections in zip(frames, photos, found, strict=True)
    ]


def as_photo(frame: Frame, image: Pixels) -> Photo:
    """What detectors see of a frame."""
    return Photo(
        image=image,
        frame_id=frame.frame_id,
        path=frame.image_path,
        intrinsics=frame.intrinsics,
        camera_offset=frame.camera_offset,
    )


def _with_objects(frame: Frame, detections: Sequence[Detection2D] | None) -> Frame:
    """Detections as objects, the labels kept aside; the largest of them is the frame's own car, if it has one."""
    if detections is None:
        return replace(frame, labels=frame.objects)
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (found.box2d for found in detections)]
    own = areas.index(max(areas)) if areas and frame.instance_id is not None else -1
    objects = []
    for number, found in enumerate(detections):
        patch_id = f"{frame.patch_prefix}-{number:03d}"
        objects.append(
            LabelledObject(
                patch_id=patch_id,
                instance_id=frame.instance_id if number == own and frame.instance_id else patch_id,
                type=found.type,
                box2d=found.box2d,
                score_2d=found.score,
                extra={"type": found.type, **frame.extra},
            )
        )
    return replace(frame, objects=tuple(objects), labels=frame.objects)


def _with_boxes(frame: Frame, photo: Photo, perception: Perception) -> Frame:
    problems = frame.problems
    if perception.boxes is not None:
        try:
            boxes = perception.boxes.estimate(photo)
        except InputError as error:
            boxes, problems = [], (*problems, f"frame {frame.frame_id} has no 3-D boxes: {error}")
    else:
        boxes = [box for box in map(_box_of_label, frame.labels) if box] if perception.uses_label_boxes else []
    joined = join([thing.box2d for thing in frame.objects], [box.box2d for box in boxes])
    objects = [_with_box(thing, boxes[joined[i]] if i in joined else None) for i, thing in enumerate(frame.objects)]
    return replace(frame, objects=tuple(objects), problems=problems)


def _box_of_label(label: LabelledObject) -> Detection3D | None:
    if label.box_center is None or label.box_size is None or label.box_yaw is None:
        return None
    return Detection3D(
        box2d=label.box2d,
        type=label.type,
        center=label.box_center,
        size=label.box_size,
        yaw=label.box_yaw,
        rotation=label.box_rotation,
        score=label.score_3d,
    )


def _with_box(thing: LabelledObject, box: Detection3D | None) -> LabelledObject:
    if box is None:
        return replace(thing, box_center=None, box_size=None, box_yaw=None, box_rotation=None, score_3d=None)
    return replace(
        thing,
        box_center=box.center,
        box_size=box.size,
        box_yaw=box.yaw,
        box_rotation=box.rotation,
        score_3d=box.score,
        extra={**thing.extra, "box3d_type": box.type},
    )


def join(boxes2d: Sequence[tuple[float, ...]], boxes3d: Sequence[tuple[float, ...]]) -> dict[int, int]:
    """Which 3-D box (value) belongs to which 2-D box (key): best overlaps in the image first, each box once."""
    if not boxes2d or not boxes3d:
        return {}
    one, other = (torch.tensor(boxes, dtype=torch.float64) for boxes in (boxes2d, boxes3d))
    overlaps = box2d_iou(one[:, None], other[None])
    joined: dict[int, int] = {}
    for place in overlaps.flatten().argsort(descending=True, stable=True).tolist():
        i, j = divmod(place, len(boxes3d))
        if overlaps[i, j] < SAME_CAR_IOU:
            break
        if i not in joined and j not in joined.values():
            joined[i] = j
    return joined
