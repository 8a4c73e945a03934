"""What SAM and SAM 2 share: one look at a photograph, then one mask per box prompt.

A box is given in pixels of the resized photograph: the photograph's pixels times the resize factor of each axis, and
nothing else (the network itself adds the half pixel to a pixel's centre), as the original predictors do.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.errors import InputError
from carstudio.perception.hub_models import Precision, low_precision
from carstudio.perception.hulls import allowed_pixels, occluded_pixels, visible_height_px
from carstudio.perception.preprocessing import Preprocessing, Size
from carstudio.perception.results import MaskResult, SegmentRequest

_GPU_BATCH = 16


@dataclass(frozen=True)
class LoadedSam:
    """A network with what is needed to ask it."""

    network: nn.Module
    preprocessing: Preprocessing
    side: int  # px of the square that the network sees
    device: torch.device


@dataclass(frozen=True, kw_only=True)
class BoxPromptSegmenter:
    """Masks by box prompts. Holds settings only: the network is loaded by each process that asks, once."""

    name: str
    """Hub name, or folder as save_pretrained writes it."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""
    multimask: bool = False
    """True: three masks per box, of which the one with the best predicted IoU is taken. Released: one mask."""
    batch: int | None = None
    """Boxes per pass of the mask decoder; None: 16 on a GPU, 1 on a CPU, where more give nothing."""
    precision: Precision = "auto"
    """Of the image encoder, which takes nearly all the time; auto: float16 on CUDA, float32 elsewhere."""
    margin: float = 0.03
    """Where this car might hide behind a nearer one: its outline widened by this share of the box's height."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        """Mask of one car; `segment_all` for all cars of a photograph costs hardly more."""
        return self.segment_all([request])[0]

    @torch.inference_mode()
    def segment_all(self, requests: Sequence[SegmentRequest]) -> list[MaskResult]:
        """Masks of the cars of one photograph; score: the network's predicted IoU."""
        if not requests:
            return []
        image = requests[0].image
        assert all(request.image.shape == image.shape for request in requests), "all cars are of one photograph"
        loaded = self.open()
        size = (image.shape[0], image.shape[1])
        pixels = loaded.preprocessing.pixels(image)
        if pixels.shape != (3, loaded.side, loaded.side):
            raise InputError(
                f"{self.name}: its preprocessor_config.json makes pictures of {tuple(pixels.shape[1:])} px, its "
                f"network expects {loaded.side} x {loaded.side}; take the file that belongs to the model"
            )
        with low_precision(self.precision, loaded.device):
            embedding = self.embed(loaded.network, pixels[None].to(loaded.device))
        prompts = box_prompts([request.box2d for request in requests], size, loaded.preprocessing.resized(size))
        results: list[MaskResult] = []
        step = self.batch or (1 if loaded.device.type == "cpu" else _GPU_BATCH)
        for start in range(0, len(requests), step):
            part = prompts[start : start + step]
            # Always full, the last box repeated: kernels differ with the number of boxes, and so would results.
            full = torch.cat([part, part[-1:].expand(step - len(part), 4)])
            output = self.decode(loaded.network, embedding, full[None].to(loaded.device))
            logits, scores = output.pred_masks[0].float(), output.iou_scores[0].float()
            for row, request in enumerate(requests[start : start + step]):
                best = int(scores[row].argmax())
                mask = self.to_photo(logits[row, best], loaded, size)
                results.append(self._result(request, mask > 0, float(scores[row, best])))
        return results

    def _result(self, request: SegmentRequest, mask: Tensor, score: float) -> MaskResult:
        window = request.window
        allowed = allowed_pixels(request, self.margin * visible_height_px(request), window)
        unknown = occluded_pixels(request, window) & allowed
        car: np.ndarray = mask[window.slices].cpu().numpy()
        return MaskResult(car & ~unknown, unknown, min(max(score, 0.0), 1.0))

    @abstractmethod
    def open(self) -> LoadedSam:
        """Load the network, once per process; `InputError` when there is none."""

    @abstractmethod
    def embed(self, network: Any, pixels: Float[Tensor, "1 3 side side"]) -> Any:
        """What the image encoder makes of the photograph, in float32."""

    @abstractmethod
    def decode(self, network: Any, embedding: Any, boxes: Float[Tensor, "1 box 4"]) -> Any:
        """The network's answer to box prompts, with `pred_masks` and `iou_scores`."""

    @abstractmethod
    def to_photo(self, logits: Float[Tensor, "rows columns"], loaded: LoadedSam, size: Size) -> Tensor:
        """Mask logits at the photograph's size (height, width)."""


def box_prompts(
    boxes: Sequence[tuple[float, float, float, float]], size: Size, resized: Size
) -> Float[Tensor, "box 4"]:
    """Boxes px of the photograph, clipped to it -> px of the resized photograph. Sizes are (height, width)."""
    limit = torch.tensor([size[1], size[0], size[1], size[0]], dtype=torch.float64)
    clipped = torch.tensor(boxes, dtype=torch.float64).clamp(min=0.0).minimum(limit)
    factors = torch.tensor([resized[1], resized[0], resized[1], resized[0]], dtype=torch.float64) / limit
    return (clipped * factors).float()


def interpolate(logits: Float[Tensor, "rows columns"], size: Size) -> Float[Tensor, "height width"]:
    """Bilinear, pixel centres at +0.5, no smoothing: what both originals do with their mask logits."""
    return nn.functional.interpolate(logits[None, None], size, mode="bilinear", align_corners=False)[0, 0]
