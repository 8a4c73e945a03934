"""Segmenter `ground-truth`: the exact mask that comes with the source (synthetic photographs)."""

from dataclasses import dataclass

from carstudio.errors import InputError
from carstudio.images import decode_image
from carstudio.perception.precomputed import result_from_pixels
from carstudio.perception.results import MaskResult, SegmentRequest


@dataclass(frozen=True)
class GroundTruthSegmenter:
    """Hands on the source's mask with score 1."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        """The source's mask; `InputError` when the source has none."""
        if request.truth_mask is None:
            raise InputError(
                f"patch {request.patch_id}: the source has no masks; choose another --segmenter, such as grabcut"
            )
        pixels = decode_image(request.truth_mask, name=f"mask of patch {request.patch_id}", mode="L")
        return result_from_pixels(pixels, request, name=f"mask of patch {request.patch_id}", score=1.0)
