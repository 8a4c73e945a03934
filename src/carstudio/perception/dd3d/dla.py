"""DLA-34 (Yu et al., "Deep Layer Aggregation", CVPR 2018): trees of residual blocks whose roots join their leaves."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.perception.dd3d.layers import NormedConv

STRIDES = (8, 16, 32)
CHANNELS = (128, 256, 512)


class Block(nn.Module):
    """Two convolutions and a residual."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = NormedConv(inputs, outputs, 3, stride=stride)
        self.conv2 = NormedConv(outputs, outputs, 3, relu=False)

    def forward(self, x: Float[Tensor, "batch inputs _ _"], residual: Tensor) -> Float[Tensor, "batch outputs _ _"]:
        """The residual comes from the tree: it may have been pooled and projected."""
        return nn.functional.relu(self.conv2(self.conv1(x)).add_(residual), inplace=True)


class Root(nn.Module):
    """Joins the leaves of a tree by one 1 x 1 convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = NormedConv(inputs, outputs, 1)

    def forward(self, *leaves: Float[Tensor, "batch _ rows columns"]) -> Float[Tensor, "batch outputs rows columns"]:
        """The leaves in the order last, first, then what came from outside the tree."""
        return self.conv(torch.cat(leaves, dim=1))


class Tree(nn.Module):
    """Two blocks and their root; `extra` channels from outside join at the root.

    A level's root (`is_level_root`) also takes the tree's own pooled input.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int, extra: int = 0, is_level_root: bool = False) -> None:
        super().__init__()
        self.tree1 = Block(inputs, outputs, stride)
        self.tree2 = Block(outputs, outputs, 1)
        self.root = Root(2 * outputs + extra + (inputs if is_level_root else 0), outputs)
        self.project = NormedConv(inputs, outputs, 1, relu=False) if inputs != outputs else None
        self.stride, self.is_level_root = stride, is_level_root

    def forward(self, x: Float[Tensor, "batch inputs _ _"], *extras: Tensor) -> Float[Tensor, "batch outputs _ _"]:
        """Features at the tree's stride."""
        bottom = nn.functional.max_pool2d(x, self.stride) if self.stride > 1 else x
        first = self.tree1(x, bottom if self.project is None else self.project(bottom))
        second = self.tree2(first, first)
        return self.root(second, first, *((bottom,) if self.is_level_root else ()), *extras)


class DeepTree(nn.Module):
    """A tree of two trees. The second one's root also joins the pooled input and the first tree."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.tree1 = Tree(inputs, outputs, stride=2)
        self.tree2 = Tree(outputs, outputs, stride=1, extra=inputs + outputs)

    def forward(self, x: Float[Tensor, "batch inputs _ _"]) -> Float[Tensor, "batch outputs _ _"]:
        """Features at half the resolution."""
        first = self.tree1(x)
        return self.tree2(first, nn.functional.max_pool2d(x, 2), first)


class DLA34(nn.Module):
    """The backbone: features at strides 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        self.base_layer = NormedConv(3, 16, 7)
        self.level0 = nn.Sequential(NormedConv(16, 16, 3))
        self.level1 = nn.Sequential(NormedConv(16, 32, 3, stride=2))
        self.level2 = Tree(32, 64, stride=2)
        self.level3 = DeepTree(64, 128)
        self.level4 = DeepTree(128, 256)
        self.level5 = Tree(256, 512, stride=2, is_level_root=True)

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        """Features of `CHANNELS` at `STRIDES`."""
        level2 = self.level2(self.level1(self.level0(self.base_layer(pixels))))
        level3 = self.level3(level2)
        level4 = self.level4(level3)
        return [level3, level4, self.level5(level4)]
