"""LPIPS (Zhang et al. 2018) with AlexNet, through torchmetrics: an extra, so its absence is a reason, not an error."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST_SIDE_PX = 32  # AlexNet's strides leave nothing of a smaller image
INSTALL_HINT = "pip install 'carstudio[lpips]'"


class Lpips:
    """The perceptual distance of two images in [0, 1]; None for images with a side below `SMALLEST_SIDE_PX`."""

    def __init__(self, distance: Callable[[Tensor, Tensor], Tensor]) -> None:
        """`distance` takes two (1, 3, height, width) batches in [0, 1] and returns a scalar."""
        self._distance = distance

    def __call__(self, image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"]) -> float | None:
        """LPIPS of one image, computed on the CPU in float32."""
        if min(image.shape[:2]) < SMALLEST_SIDE_PX:
            return None
        with torch.no_grad():
            pair = [picture.detach().cpu().float().permute(2, 0, 1)[None] for picture in (image, truth)]
            return float(self._distance(pair[0], pair[1]))


def load_lpips() -> tuple[Lpips | None, str | None]:
    """LPIPS and no reason, or None and why it cannot be had here (written into the header of the result file)."""
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        metric = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()
    except ImportError as error:
        return None, f"torchmetrics or torchvision cannot be imported ({error}); {INSTALL_HINT}"
    except (
        OSError,
        RuntimeError,
    ) as error:  # no network for the weights, a broken file, a torchvision built for another torch
        return None, f"AlexNet's weights cannot be loaded ({type(error).__name__}: {error})"
    return Lpips(metric), None
