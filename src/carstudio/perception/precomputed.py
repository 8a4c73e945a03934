"""Segmenter `precomputed:FOLDER`: PNG masks made elsewhere, by patch or by photograph.

`FOLDER/PATCH_ID.png` has the size of the crop and is believed as it is; `FOLDER/FRAME_ID.png` has the size of the
photograph, covers all cars in it, and is restricted to the car by its outline. Grey 0 is background, 128 unknown,
anything else car.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from carstudio.errors import InputError
from carstudio.files import inside
from carstudio.images import read_image
from carstudio.perception.hulls import allowed_pixels, occluded_pixels
from carstudio.perception.results import MaskResult, SegmentRequest

UNKNOWN_GREY = 128  # as the store's masks have it


@dataclass(frozen=True)
class PrecomputedSegmenter:
    """Masks from a folder. They carry no confidence: the score is None."""

    folder: Path

    def segment(self, request: SegmentRequest) -> MaskResult:
        """The patch's mask, else the car's part of the photograph's."""
        path = inside(self.folder, f"{request.patch_id}.png")
        if path.is_file():
            return result_from_pixels(read_image(path, mode="L"), request, name=str(path), score=None)
        path = inside(self.folder, f"{request.frame_id}.png")
        if not path.is_file():
            raise InputError(
                f"{self.folder}: no mask {request.patch_id}.png and no {request.frame_id}.png; put one of them there"
            )
        pixels = read_image(path, mode="L")
        if pixels.shape != request.image.shape[:2]:
            raise InputError(
                f"{path}: mask must have the photograph's size {_size(request.image)}, is {_size(pixels)}; remake it"
            )
        window = request.window
        allowed = allowed_pixels(request, 0.0, window)
        result = result_from_pixels(pixels[window.slices], request, name=str(path), score=None)
        unknown = (result.unknown | occluded_pixels(request, window)) & allowed
        return MaskResult(result.car & allowed & ~unknown, unknown)


def result_from_pixels(
    pixels: UInt8[np.ndarray, "height width"], request: SegmentRequest, *, name: str, score: float | None
) -> MaskResult:
    """Masks of a grey image of the crop."""
    if pixels.shape != (request.window.height, request.window.width):
        expected = f"{request.window.width} x {request.window.height}"
        raise InputError(f"{name}: mask must have the crop's size {expected}, is {_size(pixels)}; remake it")
    unknown = pixels == UNKNOWN_GREY
    return MaskResult((pixels > 0) & ~unknown, unknown, score)


def _size(pixels: np.ndarray) -> str:
    return f"{pixels.shape[1]} x {pixels.shape[0]}"
