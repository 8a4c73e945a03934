"""CodeNeRF (Jang and Agapito 2021) in the canonical box: an auto-decoder, whose codes are learned with the field.

No photo is looked at: each car of the training data has a shape and a texture code of its own, found by its instance
id; a car that was not trained on is the mean car, until fitting makes it its own.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.models.field_model import FieldModel
from carstudio.models.interface import Latents, PatchBatch
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.encoding import octaves, positional_encoding
from carstudio.rendering.field import SamplingConfig

SHAPE_BLOCKS, TEXTURE_BLOCKS = 3, 1  # of the authors' settings for cars (srncar.json)


@dataclass(frozen=True)
class CodeNeRFConfig:
    """Sizes; the defaults are CodeNeRF's own."""

    sampling: SamplingConfig = field(default_factory=lambda: SamplingConfig(coarse=96, fine=0))
    """Samples along a ray: one pass."""
    code_size: int = 256
    """Length of each of the two codes."""
    width: int = 256
    """Width of the field."""
    position_frequencies: int = 10
    """Octaves of the position's encoding."""
    direction_frequencies: int = 4
    """Octaves of the direction's encoding."""
    cars: tuple[str, ...] = ()
    """Instance ids that have a code; the trainer fills them in from its data."""


class CodeNeRF(FieldModel):
    """Codes and field."""

    encoder_side_px = 8  # photos are not looked at

    def __init__(self, config: CodeNeRFConfig) -> None:
        super().__init__()
        self.config = config
        self.sampling = config.sampling
        self.shape_codes, self.texture_codes = (new_codes(config.cars, config.code_size) for _ in range(2))
        self.field = CodeNeRFField(config)

    def code_parameters(self) -> tuple[nn.Parameter, ...]:
        """The codes of all cars."""
        return self.shape_codes, self.texture_codes

    def encode(self, patches: PatchBatch) -> Latents:
        """Each car's codes; the mean of all codes for a car that has none."""
        cars, wanted = self.config.cars, patches.instance_ids
        shape, texture = (codes_of(codes, cars, wanted) for codes in (self.shape_codes, self.texture_codes))
        return Latents(shape, texture)

    def query(
        self, gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"], latents: Latents
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density and colour of the field at the samples' middles."""
        return self.field(gaussians.mean, view_directions, latents)


class CodeNeRFField(nn.Module):
    """Each code goes through a layer of its own and is added before a layer of the trunk."""

    def __init__(self, config: CodeNeRFConfig) -> None:
        super().__init__()
        self.config = config
        width, code = config.width, config.code_size
        self.position_in = nn.Linear(3 + 6 * config.position_frequencies, width)
        self.shape_in = nn.ModuleList(nn.Linear(code, width) for _ in range(SHAPE_BLOCKS))
        self.shape_layers = nn.ModuleList(nn.Linear(width, width) for _ in range(SHAPE_BLOCKS))
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.direction_in = nn.Linear(width + 3 + 6 * config.direction_frequencies, width)
        self.texture_in = nn.ModuleList(nn.Linear(code, width) for _ in range(TEXTURE_BLOCKS))
        self.texture_layers = nn.ModuleList(nn.Linear(width, width) for _ in range(TEXTURE_BLOCKS))
        self.colour_hidden = nn.Linear(width, width // 2)
        self.colour_out = nn.Linear(width // 2, 3)

    def forward(
        self,
        points: Float[Tensor, "batch ray sample 3"],
        view_directions: Float[Tensor, "batch ray 3"],
        latents: Latents,
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density per canonical unit (softplus) and colour (sigmoid)."""
        shape, texture = latents.shape[:, None, None], latents.texture[:, None, None]
        hidden = torch.relu(self.position_in(encode_points(points, self.config.position_frequencies)))
        for code_in, layer in zip(self.shape_in, self.shape_layers, strict=True):
            hidden = torch.relu(layer(hidden + torch.relu(code_in(shape))))
        hidden = self.bottleneck(hidden)
        density = nn.functional.softplus(self.density(hidden).squeeze(-1).float())
        direction = encode_points(view_directions, self.config.direction_frequencies)[:, :, None]
        direction = direction.expand(*points.shape[:3], -1)
        hidden = torch.relu(self.direction_in(torch.cat([hidden, direction], dim=-1)))
        for code_in, layer in zip(self.texture_in, self.texture_layers, strict=True):
            hidden = torch.relu(layer(hidden + torch.relu(code_in(texture))))
        colour = self.colour_out(torch.relu(self.colour_hidden(hidden)))
        return density, torch.sigmoid(colour.float())


def new_codes(cars: tuple[str, ...], size: int) -> nn.Parameter:
    """A random row per car (one, where there is none yet)."""
    return nn.Parameter(torch.randn(max(1, len(cars)), size) * (2 / size) ** 0.5)


def codes_of(
    codes: Float[Tensor, "car code"], cars: tuple[str, ...], wanted: tuple[str, ...]
) -> Float[Tensor, "batch code"]:
    """Rows of the wanted cars; the mean of all rows for a car that has none."""
    row_of = {name: row for row, name in enumerate(cars)}
    rows = [row_of.get(name) for name in wanted]
    known = codes[torch.tensor([0 if row is None else row for row in rows], device=codes.device)]
    if None not in rows:
        return known
    is_known = torch.tensor([row is not None for row in rows], device=codes.device)
    return torch.where(is_known[:, None], known, codes.mean(dim=0))


def encode_points(values: Float[Tensor, "*shape 3"], count: int) -> Float[Tensor, "*shape feature"]:
    """The values themselves, then sines and cosines of NeRF's octaves."""
    return torch.cat([values, positional_encoding(values, octaves(count, values))], dim=-1)
