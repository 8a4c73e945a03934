"""Convolutions that are followed by a normalisation, and the one that has swallowed it."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

EPSILON = 1e-5


class FrozenBatchNorm(nn.Module):
    """Batch normalisation whose statistics, scale and shift are constants: no training changes them."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name, value in (("weight", 1.0), ("bias", 0.0), ("running_mean", 0.0), ("running_var", 1.0)):
            self.register_buffer(name, torch.full((channels,), value))
        self.eps = EPSILON

    def forward(self, x: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch channels rows columns"]:
        """(x - mean) / std * weight + bias."""
        return nn.functional.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)


class NormedConv(nn.Conv2d):
    """Convolution without bias (sides kept, or divided by `stride`), frozen normalisation, ReLU where asked."""

    def __init__(self, inputs: int, outputs: int, side: int, *, stride: int = 1, relu: bool = True) -> None:
        super().__init__(inputs, outputs, side, stride=stride, padding=side // 2, bias=False)
        self.norm: nn.Module = FrozenBatchNorm(outputs)
        self.relu = relu

    def forward(self, x: Float[Tensor, "batch inputs _ _"]) -> Float[Tensor, "batch outputs _ _"]:
        """Features of the next layer."""
        x = self.norm(super().forward(x))
        return nn.functional.relu(x, inplace=True) if self.relu else x


def folded(conv: nn.Conv2d, norm: nn.Module) -> tuple[Tensor, Tensor]:
    """Weight and bias of one convolution that does what `conv` and then `norm` (in evaluation mode) do."""
    assert conv.bias is None, "convolutions in front of a normalisation have no bias"
    assert isinstance(norm, FrozenBatchNorm | nn.BatchNorm2d), type(norm)
    assert norm.running_var is not None, "statistics are tracked"
    assert norm.running_mean is not None, "statistics are tracked"
    scale = norm.weight.double() / (norm.running_var.double() + norm.eps).sqrt()
    weight = conv.weight.double() * scale[:, None, None, None]
    bias = norm.bias.double() - norm.running_mean.double() * scale
    return weight.to(conv.weight.dtype), bias.to(conv.weight.dtype)


@torch.no_grad()
def fold_norms(network: nn.Module) -> None:
    """Let every convolution swallow the frozen normalisation that follows it, in place; last digits change."""
    for module in network.modules():
        if isinstance(module, NormedConv):
            _swallow(module, module.norm)
            module.norm = nn.Identity()
        elif isinstance(module, nn.Sequential):
            for (_, conv), (name, norm) in pairwise(list(module.named_children())):
                if isinstance(conv, nn.Conv2d) and isinstance(norm, FrozenBatchNorm):
                    _swallow(conv, norm)
                    module.add_module(name, nn.Identity())


def _swallow(conv: nn.Conv2d, norm: nn.Module) -> None:
    weight, bias = folded(conv, norm)
    conv.weight, conv.bias = nn.Parameter(weight), nn.Parameter(bias)
