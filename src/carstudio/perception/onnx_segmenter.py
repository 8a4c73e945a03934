"""Segmenter `onnx:FILE`: a semantic segmentation network in ONNX, restricted to one car by its outline.

The file takes `images` float32 [1, 3, H, W], RGB 0 to 255, sides multiples of 32, and returns class probabilities
[1, classes, H, W] with PASCAL VOC's classes (car is 7). It does not separate cars that touch: pixels of nearer objects
become unknown and pixels outside the car's own outline are not car.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from carstudio.errors import InputError, first_line
from carstudio.perception.hulls import allowed_pixels, clean_mask, enlarged_window, occluded_pixels, visible_height_px
from carstudio.perception.onnx_session import start_session
from carstudio.perception.results import MaskResult, SegmentRequest

VOC_CAR = 7
_ROUNDING = 1e-3  # of a probability, in networks of half precision
_SIDE_STEP = 32  # the network's sides are multiples of this ...
_SIDE_LEAST = 64  # ... and at least this


@dataclass(frozen=True)
class OnnxSegmenter:
    """Settings measured on KITTI's labelled cars (docs/dataset_format.md)."""

    file: Path
    enlarge: float = 1.3  # context around the 2-D box
    side_px: int = 384  # the network's training size; long side of the enlarged crop
    zoom_most: float = 3.0  # small cars are not blown up further
    threshold: float = 0.5  # probability above which a pixel is car
    margin: float = 0.03  # outline widened by this share of the box's height: labels are that exact

    def segment(self, request: SegmentRequest) -> MaskResult:
        """Car where the class probability is above the threshold; score: mean probability of the car's pixels."""
        context = enlarged_window(request, self.enlarge)
        probability = self._probability(np.ascontiguousarray(request.image[context.slices]))
        window = request.window
        probability = probability[window.within(context).slices]
        allowed = allowed_pixels(request, self.margin * visible_height_px(request), window)
        unknown = occluded_pixels(request, window) & allowed
        car = clean_mask((probability > self.threshold) & allowed & ~unknown) & ~unknown
        return MaskResult(car, unknown, float(probability[car].mean()) if car.any() else 0.0)

    def _probability(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width"]:
        height, width = image.shape[:2]
        zoom = min(self.side_px / max(height, width), self.zoom_most)
        size = (max(1, round(width * zoom)), max(1, round(height * zoom)))
        scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR)
        below, right = (_padded(side) - side for side in scaled.shape[:2])
        padded = cv2.copyMakeBorder(scaled, 0, below, 0, right, cv2.BORDER_REPLICATE)
        inputs = padded.astype(np.float32).transpose(2, 0, 1)[None]
        probability = _run(open_session(str(self.file)), inputs, str(self.file))[: size[1], : size[0]]
        return cv2.resize(np.ascontiguousarray(probability), (width, height), interpolation=cv2.INTER_LINEAR)


def _padded(side: int) -> int:
    return max(_SIDE_LEAST, math.ceil(side / _SIDE_STEP) * _SIDE_STEP)


@lru_cache(maxsize=2)
def open_session(file: str) -> Any:
    """An onnxruntime session on one CPU thread: the same bits however many processes run."""
    session = start_session(file, "segmentation")
    shape = session.get_outputs()[0].shape
    if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] <= VOC_CAR:
        raise InputError(f"{file}: expected an output [1, classes, height, width] with VOC's classes, found {shape}")
    _run(session, np.zeros((1, 3, _SIDE_LEAST, 2 * _SIDE_LEAST), np.float32), file)  # before a build begins
    return session


def _run(session: Any, images: Float[np.ndarray, "1 3 h w"], file: str) -> Float[np.ndarray, "h w"]:
    """Probability that a pixel is of a car; `InputError` when the network is not one that tells it."""
    try:
        output = np.asarray(session.run(None, {session.get_inputs()[0].name: images})[0])
    except Exception as error:  # onnxruntime's exceptions share no public base class
        raise InputError(
            f"{file}: expected a network that takes float32 [1, 3, height, width] with sides in steps of {_SIDE_STEP}, "
            f"found one that fails on {list(images.shape)} ({first_line(error)})"
        ) from error
    if output.ndim != 4 or output.shape[1] <= VOC_CAR or output.shape[2:] != images.shape[2:]:
        raise InputError(
            f"{file}: expected an output [1, classes, {images.shape[2]}, {images.shape[3]}] for this photograph, found "
            f"{list(output.shape)}; resample inside the network"
        )
    probability = output[0, VOC_CAR].astype(np.float32)
    if not (probability.min() >= -_ROUNDING and probability.max() <= 1 + _ROUNDING):  # NaN fails too
        raise InputError(
            f"{file}: expected probabilities from 0 to 1, found {probability.min():.3g} to {probability.max():.3g}; "
            "end the network with a softmax"
        )
    return probability
