"""Segmenter `grabcut`: OpenCV's GrabCut, seeded by the projected 3-D box. It needs no weights.

GrabCut fits colour models to car and surroundings and cuts between them (Rother et al., SIGGRAPH 2004).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from carstudio.perception.hulls import (
    allowed_pixels,
    clean_mask,
    enlarged_window,
    fill_hull,
    occluded_pixels,
    outline,
    shrink,
    visible_height_px,
)
from carstudio.perception.results import MaskResult, SegmentRequest

_NO_CAR_COLOUR = (0, 255, 0)  # nearer objects are painted over, so that cars of one colour do not confuse the models


@dataclass(frozen=True)
class GrabCutSegmenter:
    """Settings chosen on 59 KITTI cars (docs/dataset_format.md). It has no confidence: the score is None."""

    enlarge: float = 1.3  # surroundings that teach the background's colours
    core: float = 0.75  # without a 3-D box: the 2-D box shrunk by this factor is surely car
    margin: float = 0.03  # outline widened by this share of the box's height: labels are that exact
    iterations: int = 2  # five give the same masks in 2.5 times the time
    seed: int = 0  # of OpenCV's generator, which starts the colour clusters

    def segment(self, request: SegmentRequest) -> MaskResult:
        """Car where the cut says so, inside the outline (or the 2-D box when there is none)."""
        context = enlarged_window(request, self.enlarge)
        allowed = allowed_pixels(request, self.margin * visible_height_px(request), context)
        occluded = occluded_pixels(request, context)
        core = np.zeros_like(allowed)
        for part in request.core or (shrink(outline(request), self.core),):
            core |= fill_hull(part, context)
        labels = np.full(allowed.shape, cv2.GC_BGD, np.uint8)
        labels[allowed & ~occluded] = cv2.GC_PR_FGD
        labels[core & allowed & ~occluded] = cv2.GC_FGD
        image = request.image[context.slices].copy()
        image[occluded] = _NO_CAR_COLOUR
        found = self._cut(image, labels)
        crop = request.window.within(context).slices
        unknown = (occluded & allowed)[crop]
        return MaskResult(clean_mask(found[crop] & ~unknown) & ~unknown, unknown)

    def _cut(
        self, image: UInt8[np.ndarray, "height width 3"], labels: UInt8[np.ndarray, "height width"]
    ) -> Bool[np.ndarray, "height width"]:
        """Labels are changed in place; without both kinds of seed there is nothing to cut."""
        if (labels == cv2.GC_PR_FGD).any() and (labels == cv2.GC_BGD).any():
            cv2.setRNGSeed(self.seed)
            background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
            unused = (0, 0, 1, 1)
            cv2.grabCut(image, labels, unused, background, foreground, self.iterations, cv2.GC_INIT_WITH_MASK)
        return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
