"""Feature pyramid (Lin et al., CVPR 2017): the backbone's levels enriched from the coarser ones, 256 channels each."""

import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from carstudio.perception.dd3d.layers import NormedConv

CHANNELS = 256
NUM_LEVELS = 5  # whatever the backbone gives, the pyramid is continued to five


class TopBlock(nn.Module):
    """The levels above the backbone's: P6 of P5, and P7 of P6 where the pyramid starts at P3."""

    def __init__(self, *, has_p7: bool) -> None:
        super().__init__()
        self.p6 = nn.Conv2d(CHANNELS, CHANNELS, 3, stride=2, padding=1)
        self.p7 = nn.Conv2d(CHANNELS, CHANNELS, 3, stride=2, padding=1) if has_p7 else None

    def forward(self, p5: Float[Tensor, "batch 256 _ _"]) -> list[Float[Tensor, "batch 256 _ _"]]:
        """P6 stays as it is; only P7 sees its ReLU."""
        p6 = self.p6(p5)
        return [p6] if self.p7 is None else [p6, self.p7(nn.functional.relu(p6))]


class FeaturePyramid(nn.Module):
    """Five levels of a backbone with features of `channels` at `strides`."""

    def __init__(self, bottom_up: nn.Module, channels: Sequence[int], strides: Sequence[int]) -> None:
        super().__init__()
        self.names = [round(math.log2(stride)) for stride in strides]
        for name, inputs in zip(self.names, channels, strict=True):
            self.add_module(f"fpn_lateral{name}", NormedConv(inputs, CHANNELS, 1, relu=False))
            self.add_module(f"fpn_output{name}", NormedConv(CHANNELS, CHANNELS, 3, relu=False))
        self.top_block = TopBlock(has_p7=len(channels) + 2 == NUM_LEVELS)
        self.bottom_up = bottom_up
        self.strides = tuple(strides[0] * 2**level for level in range(NUM_LEVELS))

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch 256 _ _"]]:
        """The levels, finest first."""
        features = self.bottom_up(pixels)
        merged = self.get_submodule(f"fpn_lateral{self.names[-1]}")(features[-1])
        levels = [self.get_submodule(f"fpn_output{self.names[-1]}")(merged)]
        for name, feature in zip(self.names[-2::-1], features[-2::-1], strict=True):
            coarser = nn.functional.interpolate(merged, scale_factor=2.0, mode="nearest")
            merged = self.get_submodule(f"fpn_lateral{name}")(feature) + coarser
            levels.insert(0, self.get_submodule(f"fpn_output{name}")(merged))
        return levels + self.top_block(levels[-1])
