"""The two heads of DD3D (section 3.1): FCOS's for 2-D boxes and classes, and its twin for 3-D boxes.

Both look at all five levels of the pyramid with the same convolutions; each level has its own normalisations, and its
own learned scales of what is predicted. All 3-D quantities are predicted once per class.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.perception.dd3d.fpn import CHANNELS, NUM_LEVELS
from carstudio.perception.dd3d.layers import FrozenBatchNorm

DEPTH_MEAN = (32.594, 15.178, 8.424, 5.004, 4.662)  # of the training data per level; constants of the checkpoints
DEPTH_STD = (14.682, 7.139, 4.345, 2.399, 2.587)
_TOWER = 4  # convolutions


@dataclass(frozen=True)
class HeadOutputs:
    """What the heads say of the cells of one level, raw: what a training's losses would take.

    Channels of the 3-D quantities are component x class, the class running fastest.
    """

    logits: Float[Tensor, "batch classes rows columns"]
    centerness: Float[Tensor, "batch 1 rows columns"]  # logit
    box2d: Float[Tensor, "batch 4 rows columns"]  # distances to left, top, right, bottom, px, >= 0
    quaternion: Float[Tensor, "batch four_classes rows columns"]  # w, x, y, z, allocentric, not normalised
    center: Float[Tensor, "batch two_classes rows columns"]  # of the projected box, px from the cell's location
    depth: Float[Tensor, "batch classes rows columns"]  # m, for the camera whose pixels are 1 / 500 wide
    size: Float[Tensor, "batch three_classes rows columns"]  # width, length, height: before tanh, of the class's own
    confidence: Float[Tensor, "batch classes rows columns"]  # logit

    def to(self, device: torch.device | str) -> "HeadOutputs":
        """The same on another device."""
        return HeadOutputs(*(getattr(self, field.name).to(device) for field in fields(self)))


class Scale(nn.Module):
    """A learned factor."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor([value]))


class Offset(nn.Module):
    """A learned summand."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor([value]))


class Scales(nn.ModuleList):
    """A learned factor per level."""

    def __init__(self, values: Sequence[float]) -> None:
        super().__init__(Scale(value) for value in values)

    def of_level(self, level: int) -> Float[Tensor, "1"]:
        """The level's factor."""
        return self.get_parameter(f"{level}.scale")


class Offsets(nn.ModuleList):
    """A learned summand per level."""

    def __init__(self, values: Sequence[float]) -> None:
        super().__init__(Offset(value) for value in values)

    def of_level(self, level: int) -> Float[Tensor, "1"]:
        """The level's summand."""
        return self.get_parameter(f"{level}.bias")


class SharedConv(nn.Conv2d):
    """One convolution for all levels, then each level's own normalisation and ReLU."""

    def __init__(self, norm: type[nn.Module]) -> None:
        super().__init__(CHANNELS, CHANNELS, 3, padding=1, bias=False)
        self.norm = nn.ModuleList(norm(CHANNELS) for _ in range(NUM_LEVELS))

    def of_level(
        self, x: Float[Tensor, "batch 256 rows columns"], level: int
    ) -> Float[Tensor, "batch 256 rows columns"]:
        """Features of the next layer."""
        return nn.functional.relu(self.norm[level](self(x)), inplace=True)


class Tower(nn.ModuleList):
    """Four shared convolutions in a row."""

    def __init__(self, norm: type[nn.Module]) -> None:
        super().__init__(SharedConv(norm) for _ in range(_TOWER))

    def of_level(
        self, x: Float[Tensor, "batch 256 rows columns"], level: int
    ) -> Float[Tensor, "batch 256 rows columns"]:
        """What the predictors see."""
        for layer in self:
            assert isinstance(layer, SharedConv), "a tower holds shared convolutions"
            x = layer.of_level(x, level)
        return x


def predictor(outputs: int, *, bias: bool = True) -> nn.Conv2d:
    """The last convolution before an output."""
    return nn.Conv2d(CHANNELS, outputs, 3, padding=1, bias=bias)


class FCOS2DHead(nn.Module):
    """Classes, centerness and distances to the sides of the 2-D box (Tian et al., "FCOS", ICCV 2019)."""

    def __init__(self, num_classes: int, strides: Sequence[int]) -> None:
        super().__init__()
        self.cls_tower = Tower(nn.BatchNorm2d)
        self.box2d_tower = Tower(nn.BatchNorm2d)
        self.cls_logits = predictor(num_classes)
        self.box2d_reg = predictor(4)
        self.centerness = predictor(1)
        self.scales_box2d_reg = Scales([float(stride) for stride in strides])


class FCOS3DHead(nn.Module):
    """Allocentric quaternion, projected centre, depth, size and confidence of the 3-D box, for each class."""

    mean_depth_per_level: Tensor
    std_depth_per_level: Tensor

    def __init__(self, num_classes: int, strides: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("mean_depth_per_level", torch.tensor(DEPTH_MEAN))
        self.register_buffer("std_depth_per_level", torch.tensor(DEPTH_STD))
        self.box3d_tower = Tower(FrozenBatchNorm)
        self.box3d_quat = nn.ModuleList([predictor(4 * num_classes)])
        self.box3d_ctr = nn.ModuleList([predictor(2 * num_classes)])
        self.box3d_depth = nn.ModuleList([predictor(num_classes, bias=False)])
        self.box3d_size = nn.ModuleList([predictor(3 * num_classes)])
        self.box3d_conf = nn.ModuleList([predictor(num_classes)])
        self.scales_proj_ctr = Scales([float(stride) for stride in strides])
        self.scales_size = Scales([1.0] * NUM_LEVELS)
        self.scales_conf = Scales([1.0] * NUM_LEVELS)
        self.scales_depth = Scales([0.3 * std for std in DEPTH_STD])
        self.offsets_depth = Offsets(DEPTH_MEAN)


def look(
    head2d: FCOS2DHead, head3d: FCOS3DHead, features: Sequence[Float[Tensor, "batch 256 _ _"]]
) -> list[HeadOutputs]:
    """Both heads on every level, level by level, layer by layer: the definition (`fused` is the fast path)."""
    outputs = []
    for level, feature in enumerate(features):
        of_class = head2d.cls_tower.of_level(feature, level)
        of_box2d = head2d.box2d_tower.of_level(feature, level)
        of_box3d = head3d.box3d_tower.of_level(feature, level)
        outputs.append(
            HeadOutputs(
                logits=head2d.cls_logits(of_class),
                centerness=head2d.centerness(of_box2d),
                box2d=nn.functional.relu(head2d.box2d_reg(of_box2d) * head2d.scales_box2d_reg.of_level(level)),
                quaternion=head3d.box3d_quat[0](of_box3d),
                center=head3d.box3d_ctr[0](of_box3d) * head3d.scales_proj_ctr.of_level(level),
                depth=head3d.box3d_depth[0](of_box3d) * head3d.scales_depth.of_level(level)
                + head3d.offsets_depth.of_level(level),
                size=head3d.box3d_size[0](of_box3d) * head3d.scales_size.of_level(level),
                confidence=head3d.box3d_conf[0](of_box3d) * head3d.scales_conf.of_level(level),
            )
        )
    return outputs
