"""DD3D: a backbone, a feature pyramid, two fully convolutional heads, and boxes read off every cell.

The photo goes in as 8-bit BGR, its camera beside it; nothing in the network depends on the size of either.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from carstudio.geometry.camera import Camera
from carstudio.perception.dd3d import dla, vovnet
from carstudio.perception.dd3d.decoding import Detections, Selection, candidates
from carstudio.perception.dd3d.fpn import FeaturePyramid
from carstudio.perception.dd3d.fused import FusedHeads
from carstudio.perception.dd3d.heads import FCOS2DHead, FCOS3DHead, HeadOutputs, look
from carstudio.perception.dd3d.layers import fold_norms
from carstudio.perception.dd3d.nms import Suppression, settled

Backbone = Literal["dla34", "v2-99"]
PIXEL_MEAN = (103.530, 116.280, 123.675)  # B, G, R
PIXEL_STD = (57.375, 57.120, 58.395)
# Class -> canonical width, length, height in m: the means of KITTI's training data, constants of the released models.
KITTI_CLASSES = {
    "Car": (1.61876949, 3.89154523, 1.52969237),
    "Pedestrian": (0.62806586, 0.82038497, 1.76784787),
    "Cyclist": (0.56898187, 1.77149234, 1.7237099),
    "Van": (1.9134491, 5.15499603, 2.18998422),
    "Truck": (2.61168401, 9.22692319, 3.36492722),
}


@dataclass(frozen=True)
class DD3DConfig:
    """Which of the released KITTI models, and what becomes of its raw outputs."""

    backbone: Backbone
    selection: Selection = field(default_factory=Selection)
    suppression: Suppression = field(default_factory=Suppression)

    @property
    def side_step(self) -> int:
        """Both sides of the network's input are padded to multiples of this, px."""
        return 128 if self.backbone == "dla34" else 64


class DD3D(nn.Module):
    """Photos and cameras in, 3-D boxes out. Weights are random until loaded."""

    pixel_mean: Tensor
    pixel_std: Tensor
    canonical_sizes: Tensor

    def __init__(self, config: DD3DConfig) -> None:
        super().__init__()
        self.config = config
        self.register_buffer("pixel_mean", torch.tensor(PIXEL_MEAN)[:, None, None])
        self.register_buffer("pixel_std", torch.tensor(PIXEL_STD)[:, None, None])
        self.register_buffer("canonical_sizes", torch.tensor(list(KITTI_CLASSES.values())), persistent=False)
        if config.backbone == "dla34":
            self.backbone = FeaturePyramid(dla.DLA34(), dla.CHANNELS, dla.STRIDES)
        else:
            self.backbone = FeaturePyramid(vovnet.VoVNet99(), vovnet.CHANNELS, vovnet.STRIDES)
        self.fcos2d_head = FCOS2DHead(len(KITTI_CLASSES), self.backbone.strides)
        self.fcos3d_head = FCOS3DHead(len(KITTI_CLASSES), self.backbone.strides)
        self.fused_heads: FusedHeads | None = None
        self.precision = torch.float32

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[HeadOutputs]:
        """Raw outputs of the heads for each level, of what `prepare` makes of photos."""
        features = self.backbone(pixels.to(self.precision))
        if self.fused_heads is not None:
            return self.fused_heads(features)
        return look(self.fcos2d_head, self.fcos3d_head, features)

    @torch.no_grad()
    def fuse(self) -> "DD3D":
        """Make it quicker, in place and for inference only: no normalisations, channels last."""
        fold_norms(self.backbone)
        self.fused_heads = FusedHeads(self.fcos2d_head, self.fcos3d_head)
        del self.fcos2d_head, self.fcos3d_head
        for parameter in self.eval().requires_grad_(False).parameters():
            if parameter.dim() == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        return self

    def set_precision(self, precision: torch.dtype) -> "DD3D":
        """Let a fused network compute in `precision`, but for the last convolutions and the decoding."""
        assert self.fused_heads is not None, "only a fused network computes in low precision"
        self.backbone.to(precision)
        self.fused_heads.set_precision(precision)
        self.precision = precision
        return self

    def prepare(self, images: Sequence[UInt8[Tensor, "3 _ _"]]) -> Float[Tensor, "batch 3 height width"]:
        """BGR photos of any size, normalised, zeros to their right and below up to a common size."""
        step = self.config.side_step
        height, width = (max(-(-image.shape[i] // step) * step for image in images) for i in (1, 2))
        pixels = self.pixel_mean.new_zeros(len(images), 3, height, width)
        for row, image in zip(pixels, images, strict=True):
            row[:, : image.shape[1], : image.shape[2]] = (image - self.pixel_mean) / self.pixel_std
        return pixels

    def detect(self, images: Sequence[UInt8[Tensor, "3 _ _"]], cameras: Sequence[Camera]) -> list[Detections]:
        """The boxes of each photo, px of the photo as given (not clipped to it), the surest 3-D box first."""
        pixels = self.prepare(images)
        if self.fused_heads is not None:
            pixels = pixels.contiguous(memory_format=torch.channels_last)
        outputs = self(pixels)
        intrinsics = torch.stack([camera.intrinsics for camera in cameras]).to(pixels)
        together, sizes = Camera(intrinsics, pixels.shape[-1], pixels.shape[-2]), self.canonical_sizes
        if pixels.device.type == "mps":  # decoding is little work with operators that not every device has
            outputs, together, sizes = [level.to("cpu") for level in outputs], together.to("cpu"), sizes.cpu()
        found = candidates(outputs, self.backbone.strides, together, sizes, self.config.selection)
        return [settled(boxes, self.config.suppression) for boxes in found]
