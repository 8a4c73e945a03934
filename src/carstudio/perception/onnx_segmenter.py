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

from carstudio.errors import InputError
from carstudio.perception.hulls import allowed_pixels, clean_mask, enlarged_window, occluded_pixels
from carstudio.perception.results import MaskResult, SegmentRequest

VOC_CAR = 7
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
        height_px = request.box2d[3] - request.box2d[1]
        allowed = allowed_pixels(request, self.margin * height_px, window)
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
        session = open_session(str(self.file))
        output = session.run(None, {session.get_inputs()[0].name: inputs})[0]
        probability = np.asarray(output)[0, VOC_CAR, : size[1], : size[0]]
        return cv2.resize(probability, (width, height), interpolation=cv2.INTER_LINEAR)


def _padded(side: int) -> int:
    return max(_SIDE_LEAST, math.ceil(side / _SIDE_STEP) * _SIDE_STEP)


@lru_cache(maxsize=2)
def open_session(file: str) -> Any:
    """An onnxruntime session on one CPU thread: the same bits however many processes run."""
    try:
        import onnxruntime
    except ImportError as error:
        raise InputError('onnx: needs onnxruntime; install it with: pip install "carstudio[onnx]"') from error
    if not Path(file).is_file():
        raise InputError(f"onnx: no file {file}; expected a segmentation network (onnx:FILE)")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no public base class
        raise InputError(f"{file}: expected an ONNX network, found something else ({error})") from error
    shape = session.get_outputs()[0].shape
    if len(shape) != 4 or not isinstance(shape[1], int) or shape[1] <= VOC_CAR:
        raise InputError(f"{file}: expected an output [1, classes, height, width] with VOC's classes, found {shape}")
    return session
