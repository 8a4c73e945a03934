"""Car-NeRF (Car-Studio section III-C, Eq. 3-4): a radiance field in the canonical box, conditioned on two codes.

Notation: h the trunk's hidden state, gamma the encodings, z_s and z_t the shape and texture codes. The density knows
gamma(position) and z_s only; colour adds the direction and z_t, so a recoloured car keeps its shape to the bit.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.models.encoders import EncoderConfig, build_encoder, load_imagenet
from carstudio.models.field_model import FieldModel
from carstudio.models.interface import Latents, PatchBatch
from carstudio.models.patch_features import POSE_FEATURES, pose_features, tiny_masked_copy
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.encoding import (
    integrated_positional_encoding,
    octaves,
    positional_encoding,
    released_frequencies,
)
from carstudio.rendering.field import SamplingConfig


@dataclass(frozen=True)
class CarNeRFConfig:
    """Sizes of Car-NeRF; the defaults are the paper's and the release's."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Photo to features."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Samples along a ray."""
    code_size: int = 128
    """Length of each of the two codes."""
    width: int = 256
    """Width of the trunk."""
    depth: int = 8
    """Layers of the trunk, the first included."""
    skip_after: int | None = 5
    """Layer after whose activation position and shape code are added again (counted from 1); None: no skip."""
    position_encoding: Literal["integrated", "points"] = "integrated"
    """"integrated": of the cone's Gaussian, which fades what a pixel cannot resolve; "points": of its mean alone, as
    NeRF and AutoRF do."""
    position_frequencies: int = 16
    """Octaves of the positional encoding."""
    direction_frequencies: int = 4
    """Octaves of the direction's plain encoding."""
    released_encoding: bool = False
    """Frequencies 2 pi 2^linspace(0, n, n), variance damped without the 2 pi: the released code's encoding."""
    normalise_codes: bool = False
    """LayerNorm on both codes (small recipes: keeps a young encoder from drowning the position)."""
    colour_skip_px: int = 0
    """Side of a tiny copy of the masked crop, added to the texture code by a linear map; 0: none, as the paper."""
    encode_pose: bool = False
    """Tell the encoder the car's pose in the camera and its size (not in the paper; known wherever there is a box)."""


class CarNeRF(FieldModel):
    """Encoder, two linear maps to the codes, and the field."""

    def __init__(self, config: CarNeRFConfig) -> None:
        super().__init__()
        self.config = config
        self.sampling = config.sampling
        self.encoder_side_px = config.encoder.side_px
        self.encoder = build_encoder(config.encoder)
        num_features = config.encoder.num_features + (POSE_FEATURES if config.encode_pose else 0)
        self.shape_head = nn.Linear(num_features, config.code_size)
        self.texture_head = nn.Linear(num_features, config.code_size)
        self.shape_norm = nn.LayerNorm(config.code_size) if config.normalise_codes else nn.Identity()
        self.texture_norm = nn.LayerNorm(config.code_size) if config.normalise_codes else nn.Identity()
        if config.colour_skip_px:
            self.colour_skip = nn.Linear(3 * config.colour_skip_px**2, config.code_size)
        self.field = CarNeRFField(config)

    def load_pretrained_parts(self) -> str:
        """ImageNet weights for the encoder where the config asks for them and they can be had."""
        return load_imagenet(self.encoder, self.config.encoder)

    def encode(self, patches: PatchBatch) -> Latents:
        """z_shape and z_texture of each patch."""
        features = self.encoder(patches)
        if self.config.encode_pose:
            features = torch.cat([features, pose_features(patches)], dim=-1)
        texture = self.texture_head(features)
        if self.config.colour_skip_px:
            texture = texture + self.colour_skip(tiny_masked_copy(patches, self.config.colour_skip_px))
        return Latents(self.shape_norm(self.shape_head(features)), self.texture_norm(texture))

    def query(
        self, gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"], latents: Latents
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density and colour of the field (Eq. 3 and 4)."""
        return self.field(gaussians, view_directions, latents)


class CarNeRFField(nn.Module):
    """f_theta: the trunk (Eq. 3) and the colour head (Eq. 4); one field for coarse and fine."""

    def __init__(self, config: CarNeRFConfig) -> None:
        super().__init__()
        self.config = config
        position_size, direction_size = 6 * config.position_frequencies, 6 * config.direction_frequencies
        width, code = config.width, config.code_size
        self.position_in = nn.Linear(position_size, width)
        self.shape_in = nn.Linear(code, width)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(config.depth - 1))
        if config.skip_after is not None:
            self.position_skip = nn.Linear(position_size, width)
            self.shape_skip = nn.Linear(code, width)
        self.density = nn.Linear(width, 1)
        self.colour_in = nn.Linear(width, width)
        self.texture_in = nn.Linear(code, width)
        self.direction_in = nn.Linear(direction_size, width)
        self.colour_hidden = nn.Linear(width, width // 2)
        self.colour_out = nn.Linear(width // 2, 3)

    def forward(
        self, gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"], latents: Latents
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density (softplus) and rgb (sigmoid) at each Gaussian."""
        hidden = self._trunk(self._encode_position(gaussians), latents.shape[:, None, None])
        density = nn.functional.softplus(self.density(hidden)).squeeze(-1)
        direction = self.direction_in(self._encode_direction(view_directions))[:, :, None]
        colour = self.colour_in(hidden) + (direction + self.texture_in(latents.texture)[:, None, None])
        colour = torch.relu(self.colour_hidden(torch.relu(colour)))
        return density, torch.sigmoid(self.colour_out(colour))

    def _trunk(
        self, position: Float[Tensor, "batch ray sample feature"], shape: Float[Tensor, "batch 1 1 code"]
    ) -> Float[Tensor, "batch ray sample width"]:
        hidden = torch.relu(self.position_in(position) + self.shape_in(shape))
        for number, layer in enumerate(self.hidden, start=2):
            hidden = torch.relu(layer(hidden))
            if number == self.config.skip_after:
                hidden = hidden + self.position_skip(position) + self.shape_skip(shape)
        return hidden

    def _encode_position(self, gaussians: Gaussians) -> Float[Tensor, "batch ray sample feature"]:
        count = self.config.position_frequencies
        if self.config.position_encoding == "points":
            return positional_encoding(gaussians.mean, octaves(count, gaussians.mean))
        if not self.config.released_encoding:
            return integrated_positional_encoding(gaussians.mean, gaussians.variance, octaves(count, gaussians.mean))
        frequencies = released_frequencies(count, gaussians.mean)
        damping = frequencies / (2 * torch.pi)
        return integrated_positional_encoding(gaussians.mean, gaussians.variance, frequencies, damping)

    def _encode_direction(self, directions: Float[Tensor, "batch ray 3"]) -> Float[Tensor, "batch ray feature"]:
        frequencies = released_frequencies if self.config.released_encoding else octaves
        return positional_encoding(directions, frequencies(self.config.direction_frequencies, directions))
