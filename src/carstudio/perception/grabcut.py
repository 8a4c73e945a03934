"""Segmenter `grabcut`: OpenCV's GrabCut, seeded by the outline of the 3-D box. It needs no weights.

GrabCut fits colour models to car and surroundings and cuts between them (Rother et al., SIGGRAPH 2004).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from carstudio.perception.hulls import allowed_pixels, enlarged_window, fill_hull, occluded_pixels, outline, shrink
from carstudio.perception.results import MaskResult, SegmentRequest


@dataclass(frozen=True)
class GrabCutSegmenter:
    """Settings tried on KITTI's labelled cars (docs/dataset_format.md). It has no confidence: the score is None."""

    enlarge: float = 1.3  # surroundings that teach the background's colours
    core: float = 0.5  # the outline shrunk by this factor about its centre is surely car
    iterations: int = 5  # the mask stands still after that
    seed: int = 0  # of OpenCV's generator, which starts the colour clusters

    def segment(self, request: SegmentRequest) -> MaskResult:
        """Car where the cut says so, inside the outline (or the 2-D box when there is none)."""
        context = enlarged_window(request, self.enlarge)
        allowed = allowed_pixels(request, 0, context)
        occluded = occluded_pixels(request, context)
        core = fill_hull(shrink(outline(request), self.core), context) & allowed & ~occluded
        labels = np.full(allowed.shape, cv2.GC_BGD, np.uint8)
        labels[allowed & ~occluded] = cv2.GC_PR_FGD
        labels[core] = cv2.GC_FGD
        found = self._cut(np.ascontiguousarray(request.image[context.slices]), labels)
        crop = request.window.within(context).slices
        unknown = (occluded & allowed)[crop]
        return MaskResult(found[crop] & ~unknown, unknown)

    def _cut(
        self, image: UInt8[np.ndarray, "height width 3"], labels: UInt8[np.ndarray, "height width"]
    ) -> Bool[np.ndarray, "height width"]:
        probable = labels == cv2.GC_PR_FGD
        if not probable.any() or not (labels == cv2.GC_BGD).any():
            return (labels == cv2.GC_FGD) | probable
        cv2.setRNGSeed(self.seed)
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(image, labels, (0, 0, 1, 1), background, foreground, self.iterations, cv2.GC_INIT_WITH_MASK)
        return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
