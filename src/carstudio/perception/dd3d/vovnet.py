"""VoVNetV2-99 (Lee and Park, "CenterMask", CVPR 2020): one-shot aggregation and effective squeeze-and-excitation."""

from collections import OrderedDict

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.perception.dd3d.layers import FrozenBatchNorm

STRIDES = (4, 8, 16, 32)
CHANNELS = (256, 512, 768, 1024)
_MODULES, _WIDTHS = (1, 3, 9, 3), (128, 160, 192, 224)  # of stages 2 to 5
_LAYERS = 5  # 3 x 3 convolutions of a module


def named_conv(name: str, inputs: int, outputs: int, side: int, stride: int = 1) -> OrderedDict[str, nn.Module]:
    """Convolution, frozen normalisation and ReLU under the checkpoint's names."""
    conv = nn.Conv2d(inputs, outputs, side, stride=stride, padding=side // 2, bias=False)
    return OrderedDict(
        {f"{name}/conv": conv, f"{name}/norm": FrozenBatchNorm(outputs), f"{name}/relu": nn.ReLU(inplace=True)}
    )


class SqueezeExcitation(nn.Module):
    """Each channel weighted by what the whole picture says of it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch channels rows columns"]:
        """Features times weights in [0, 1]."""
        return x * nn.functional.hardsigmoid(self.fc(x.mean(dim=(2, 3), keepdim=True)))


class OneShotAggregation(nn.Module):
    """Convolutions in a row, all their outputs joined once; a residual but in a stage's first module."""

    def __init__(self, name: str, inputs: int, width: int, outputs: int, *, has_residual: bool) -> None:
        super().__init__()
        sizes = [inputs] + [width] * _LAYERS
        self.layers = nn.ModuleList(
            nn.Sequential(named_conv(f"{name}_{i}", sizes[i], width, 3)) for i in range(_LAYERS)
        )
        self.concat = nn.Sequential(named_conv(f"{name}_concat", inputs + _LAYERS * width, outputs, 1))
        self.ese = SqueezeExcitation(outputs)
        self.has_residual = has_residual

    def forward(self, x: Float[Tensor, "batch inputs rows columns"]) -> Float[Tensor, "batch outputs rows columns"]:
        """Features at the same resolution."""
        outputs = [x]
        for layer in self.layers:
            outputs.append(layer(outputs[-1]))
        joined = self.ese(self.concat(torch.cat(outputs, dim=1)))
        return joined + x if self.has_residual else joined


def stage(number: int, inputs: int, width: int, outputs: int, modules: int) -> nn.Sequential:
    """Halve the resolution (but in stage 2, which follows the stem), then modules one after the other."""
    parts: OrderedDict[str, nn.Module] = OrderedDict()
    if number > 2:
        parts["Pooling"] = nn.MaxPool2d(3, stride=2, ceil_mode=True)
    for i in range(modules):
        name = f"OSA{number}_{i + 1}"
        parts[name] = OneShotAggregation(name, outputs if i else inputs, width, outputs, has_residual=i > 0)
    return nn.Sequential(parts)


class VoVNet99(nn.Module):
    """The backbone: features at strides 4, 8, 16 and 32."""

    def __init__(self) -> None:
        super().__init__()
        stem = (("stem_1", 3, 64, 2), ("stem_2", 64, 64, 1), ("stem_3", 64, 128, 2))
        parts = [named_conv(name, inputs, outputs, 3, stride) for name, inputs, outputs, stride in stem]
        self.stem = nn.Sequential(OrderedDict(item for part in parts for item in part.items()))
        inputs = (128, *CHANNELS)
        self.stage2, self.stage3, self.stage4, self.stage5 = (
            stage(i + 2, inputs[i], _WIDTHS[i], CHANNELS[i], _MODULES[i]) for i in range(4)
        )

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        """Features of `CHANNELS` at `STRIDES`."""
        features = [self.stage2(self.stem(pixels))]
        for part in (self.stage3, self.stage4, self.stage5):
            features.append(part(features[-1]))
        return features
