"""Fields that take features beside position and direction: PixelNeRF's residual blocks, and NeRF's MLP."""

from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor, nn

ADDED_TO_BLOCKS = 3  # PixelNeRF adds the features before its first three blocks
SKIP_BEFORE = 5  # NeRF joins its input again to what the fifth layer gets


class PixelField(Protocol):
    """What both are."""

    def __call__(
        self,
        position: Float[Tensor, "*shape position"],
        direction: Float[Tensor, "*shape direction"],
        features: Float[Tensor, "*shape feature"],
    ) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape 3"]]:
        """Density and colour before their last activation."""


class ResNetFC(nn.Module):
    """PixelNeRF's field: position and direction in, features added before the first blocks, four numbers out."""

    def __init__(self, *, position_size: int, direction_size: int, feature_size: int, width: int, depth: int) -> None:
        super().__init__()
        self.into = _kaiming(nn.Linear(position_size + direction_size, width))
        self.features_in = nn.ModuleList(
            _kaiming(nn.Linear(feature_size, width)) for _ in range(min(ADDED_TO_BLOCKS, depth))
        )
        self.first = nn.ModuleList(_kaiming(nn.Linear(width, width)) for _ in range(depth))
        self.second = nn.ModuleList(_zero(nn.Linear(width, width)) for _ in range(depth))
        self.out = _kaiming(nn.Linear(width, 4))

    def forward(
        self,
        position: Float[Tensor, "*shape position"],
        direction: Float[Tensor, "*shape direction"],
        features: Float[Tensor, "*shape feature"],
    ) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape 3"]]:
        """Density and colour before their last activation."""
        hidden = self.into(torch.cat([position, direction], dim=-1))
        for number, (first, second) in enumerate(zip(self.first, self.second, strict=True)):
            if number < len(self.features_in):
                hidden = hidden + self.features_in[number](features)
            hidden = hidden + second(torch.relu(first(torch.relu(hidden))))
        out = self.out(torch.relu(hidden))
        return out[..., 0], out[..., 1:]


class ConcatenatingMLP(nn.Module):
    """NeRF's MLP; features are joined to the position wherever that goes in."""

    def __init__(self, *, position_size: int, direction_size: int, feature_size: int, width: int, depth: int) -> None:
        super().__init__()
        into = position_size + feature_size
        sizes = [into, *([width] * (depth - 1))]
        self.layers = nn.ModuleList(
            nn.Linear(size + (into if number == SKIP_BEFORE else 0), width) for number, size in enumerate(sizes)
        )
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.colour_hidden = nn.Linear(width + direction_size, width // 2)
        self.colour_out = nn.Linear(width // 2, 3)

    def forward(
        self,
        position: Float[Tensor, "*shape position"],
        direction: Float[Tensor, "*shape direction"],
        features: Float[Tensor, "*shape feature"],
    ) -> tuple[Float[Tensor, "*shape"], Float[Tensor, "*shape 3"]]:
        """Density and colour before their last activation."""
        into = torch.cat([position, features], dim=-1)
        hidden = into
        for number, layer in enumerate(self.layers):
            hidden = torch.cat([hidden, into], dim=-1) if number == SKIP_BEFORE else hidden
            hidden = torch.relu(layer(hidden))
        colour = torch.relu(self.colour_hidden(torch.cat([self.bottleneck(hidden), direction], dim=-1)))
        return self.density(hidden).squeeze(-1), self.colour_out(colour)


def _zero(layer: nn.Linear) -> nn.Linear:
    """The last layer of a block: a fresh block changes nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


def _kaiming(layer: nn.Linear) -> nn.Linear:
    """PixelNeRF's initialisation."""
    nn.init.kaiming_normal_(layer.weight, a=0, mode="fan_in")
    nn.init.zeros_(layer.bias)
    return layer
