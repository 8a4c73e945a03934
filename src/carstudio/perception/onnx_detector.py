"""2-D boxes by any YOLOX-type network in an ONNX file (COCO's 80 classes).

Input: float32 [1, 3, height, width], BGR in 0 to 255, letterboxed to the top left with grey 114, sides in steps of 32.
Output: [1, cells, 5 + classes]; per cell (cx, cy, log w, log h) in units of its stride, objectness and class scores;
strides 8, 16, 32 in this order, cells row by row (Ge et al., "YOLOX: Exceeding YOLO Series in 2021", section 2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from carstudio.errors import InputError, first_line
from carstudio.perception.onnx_session import start_session
from carstudio.perception.results import Detection2D, Photo
from carstudio.perception.suppression import without_doubles
from carstudio.perception.vehicle_classes import COCO_CLASS_NUMBERS

STRIDES = (8, 16, 32)
PADDING_GREY = 114
_BOX = 4  # numbers of a box, before the objectness
_NUM_CLASSES = 80
_TRIAL_SIDE = 64


@dataclass(frozen=True)
class OnnxDetector:
    """A YOLOX-type network on the whole photograph."""

    file: Path
    long_side_px: int = 1280
    """The photograph's longer side is scaled to this, but not enlarged by more than `most_enlarged`."""
    most_enlarged: float = 2.0
    """Small photographs show their cars large: enlarging them further finds no more."""
    threshold: float = 0.25
    """Least objectness x class score."""
    nms_iou: float = 0.5
    """Of two boxes of any vehicle class that overlap more, the better one stays: a pickup is often car and truck."""

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        """Photographs have many shapes: they go through the network one by one."""
        return [self._detect(photo.image) for photo in photos]

    def _detect(self, image: UInt8[np.ndarray, "height width 3"]) -> list[Detection2D]:
        height, width = image.shape[:2]
        scale = min(self.long_side_px / max(height, width), self.most_enlarged)
        output = _run(open_detector(str(self.file)), letterbox(image, scale), str(self.file))
        boxes, scores = decode(output, *_padded_size(height, width, scale))
        kinds = np.array(sorted(COCO_CLASS_NUMBERS))
        best = scores[:, kinds].argmax(axis=1)
        score = scores[np.arange(len(scores)), kinds[best]]
        sure = np.flatnonzero(score > self.threshold)
        boxes = np.clip(boxes[sure] / scale, 0, [width, height, width, height])
        found = []
        for i in without_doubles(boxes, np.argsort(-score[sure], kind="stable").tolist(), self.nms_iou):
            x0, y0, x1, y1 = boxes[i].tolist()
            if x1 - x0 >= 1 and y1 - y0 >= 1:
                kind = COCO_CLASS_NUMBERS[int(kinds[best[sure[i]]])]
                found.append(Detection2D((x0, y0, x1, y1), kind, round(float(score[sure[i]]), 6)))
        return found


def letterbox(image: UInt8[np.ndarray, "height width 3"], scale: float) -> Float[np.ndarray, "1 3 rows columns"]:
    """The network's input: scaled, in the upper left corner of a grey picture, BGR."""
    height, width = image.shape[:2]
    rows, columns = _padded_size(height, width, scale)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    canvas = np.full((rows, columns, 3), PADDING_GREY, np.uint8)
    canvas[: size[1], : size[0]] = scaled[..., ::-1]
    return canvas.astype(np.float32).transpose(2, 0, 1)[None]


def _padded_size(height: int, width: int, scale: float) -> tuple[int, int]:
    step = STRIDES[-1]
    rows, columns = (max(step, math.ceil(max(1, round(side * scale)) / step) * step) for side in (height, width))
    return rows, columns


def decode(
    output: Float[np.ndarray, "cells numbers"], rows: int, columns: int
) -> tuple[Float[np.ndarray, "cells 4"], Float[np.ndarray, "cells classes"]]:
    """Boxes (x0, y0, x1, y1 in px of the network's input) and scores, objectness times class."""
    corners, strides = [], []
    for stride in STRIDES:
        y, x = np.mgrid[: rows // stride, : columns // stride]
        corners.append(np.stack([x, y], axis=-1).reshape(-1, 2))
        strides.append(np.full(x.size, stride))
    stride_of = np.concatenate(strides)[:, None].astype(np.float64)
    center = (output[:, :2] + np.concatenate(corners)) * stride_of
    half = np.exp(np.minimum(output[:, 2:_BOX].astype(np.float64), 20.0)) * stride_of / 2
    scores = output[:, _BOX : _BOX + 1] * output[:, _BOX + 1 :]
    return np.concatenate([center - half, center + half], axis=1), scores


@lru_cache(maxsize=2)
def open_detector(file: str) -> Any:
    """The session of a YOLOX-type file, tried once on a small picture before a build begins."""
    session = start_session(file, "detection")
    _run(session, np.zeros((1, 3, _TRIAL_SIDE, 2 * _TRIAL_SIDE), np.float32), file)
    return session


def _run(session: Any, inputs: Float[np.ndarray, "1 3 rows columns"], file: str) -> Float[np.ndarray, "cells numbers"]:
    rows, columns = inputs.shape[2:]
    try:
        output = np.asarray(session.run(None, {session.get_inputs()[0].name: inputs})[0])
    except Exception as error:  # onnxruntime's exceptions share no public base class
        raise InputError(
            f"{file}: expected a network that takes float32 [1, 3, height, width] with sides in steps of "
            f"{STRIDES[-1]}, found one that fails on {list(inputs.shape)} ({first_line(error)}); export it with "
            "dynamic height and width"
        ) from error
    expected = [1, sum((rows // stride) * (columns // stride) for stride in STRIDES), _BOX + 1 + _NUM_CLASSES]
    if list(output.shape) != expected:
        raise InputError(
            f"{file}: expected the output of a YOLOX with COCO's {_NUM_CLASSES} classes, {expected}, found "
            f"{list(output.shape)}; other networks go through transformers:NAME or precomputed:FILE"
        )
    if not np.isfinite(output).all():
        raise InputError(f"{file}: the network gives numbers that are not finite; export it again")
    return output[0]
