"""PixelNeRF (Yu et al. 2021) in the canonical box: every sample looks its features up where the photo shows it.

A sample's canonical position goes through the input photo's box and camera to a pixel; the feature map there, together
with the encoded position and the line of sight, gives density and colour. `features="global"` is what Car-Studio's
release did instead: one feature vector for the whole car.
"""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.models.encoders import EncoderConfig, build_encoder, load_imagenet
from carstudio.models.field_model import FieldModel
from carstudio.models.interface import NEAR_M, Latents, PatchBatch, PixelFeatures
from carstudio.models.pixel_backbones import ConcatenatingMLP, ResNetFC
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.encoding import octaves, positional_encoding
from carstudio.rendering.field import SamplingConfig


@dataclass(frozen=True)
class PixelNeRFConfig:
    """Sizes; the defaults are PixelNeRF's own (ResNet-FC)."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    """Photo to feature map."""
    sampling: SamplingConfig = field(default_factory=lambda: SamplingConfig(coarse=64, fine=32))
    """Samples along a ray."""
    backbone: Literal["resnet", "mlp"] = "resnet"
    """"resnet": blocks that add the features; "mlp": NeRF's, the features joined to its input."""
    features: Literal["aligned", "global"] = "aligned"
    """"aligned": of the pixel that shows the sample; "global": the map's maxima for all samples, as released."""
    width: int = 512
    """Width of the field."""
    depth: int = 5
    """Blocks of two layers (resnet), or layers (mlp)."""
    position_frequencies: int = 6
    """Octaves of the position's encoding."""
    frequency_factor: float = 1.5
    """The lowest frequency, rad per canonical unit (PixelNeRF: 1.5; NeRF: 1)."""
    direction_frequencies: int = 0
    """Octaves of the direction's encoding; 0: the direction as it is (PixelNeRF)."""
    density: Literal["relu", "softplus"] = "relu"
    """What makes the density positive: PixelNeRF's ReLU may die for good, softplus does not."""


class PixelNeRF(FieldModel):
    """Feature map and field."""

    def __init__(self, config: PixelNeRFConfig) -> None:
        super().__init__()
        self.config = config
        self.is_coded = config.features == "global"
        self.sampling = config.sampling
        self.encoder_side_px = config.encoder.side_px
        self.encoder = build_encoder(config.encoder)
        backbone = ResNetFC if config.backbone == "resnet" else ConcatenatingMLP
        self.field = backbone(
            position_size=3 + 6 * config.position_frequencies,
            direction_size=3 + 6 * config.direction_frequencies,
            feature_size=config.encoder.num_features,
            width=config.width,
            depth=config.depth,
        )

    def load_pretrained_parts(self) -> str:
        """ImageNet weights for the encoder where the config asks for them and they can be had."""
        return load_imagenet(self.encoder, self.config.encoder)

    def encode(self, patches: PatchBatch) -> Latents:
        """The feature map with the camera and box it is looked up by; or its maxima as the shape code."""
        nothing = patches.image.new_zeros(len(patches.image), 0)
        if self.config.features == "global":
            return Latents(self.encoder(patches), nothing)
        found: Tensor = self.encoder.feature_map(patches.image)  # type: ignore[operator]
        return Latents(nothing, nothing, PixelFeatures(found, patches.camera, patches.box))

    def query(
        self, gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"], latents: Latents
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density and colour from position, direction and the sample's features."""
        points = gaussians.mean
        if latents.pixels is None:
            features = latents.shape[:, None, None].expand(*points.shape[:3], -1)
        else:
            features = look_up(latents.pixels, points)
        directions = self._encode(view_directions, self.config.direction_frequencies, 1.0)
        directions = directions[:, :, None].expand(*points.shape[:3], -1)
        position = self._encode(points, self.config.position_frequencies, self.config.frequency_factor)
        density, rgb = self.field(position, directions, features)
        positive = torch.relu if self.config.density == "relu" else nn.functional.softplus
        return positive(density.float()), torch.sigmoid(rgb.float())

    def _encode(self, values: Tensor, count: int, factor: float) -> Tensor:
        """The values themselves, then sines and cosines."""
        if count == 0:
            return values
        return torch.cat([values, positional_encoding(values, factor * octaves(count, values))], dim=-1)


def look_up(
    pixels: PixelFeatures, points: Float[Tensor, "batch ray sample 3"]
) -> Float[Tensor, "batch ray sample feature"]:
    """Features of the pixels that show canonical points: bilinear between pixel centres (+0.5), the edge beyond it.

    The two or more samples of a ray that share a pixel share its features: a map knows no depth. Points behind the
    input camera are looked up as if they were `NEAR_M` before it.
    """
    with torch.autocast(points.device.type, enabled=False):  # places in the photo do not bear bfloat16
        box, camera = pixels.box, pixels.camera
        in_car = points.flatten(1, 2) * box.size[:, None] / 2
        in_camera = in_car @ box.rotation.mT + box.center[:, None]
        in_camera = torch.cat([in_camera[..., :2], in_camera[..., 2:].clamp(min=NEAR_M)], dim=-1)
        share = camera.project(in_camera) / in_camera.new_tensor([camera.width, camera.height])
        found = nn.functional.grid_sample(
            pixels.map.float(), 2 * share[:, None] - 1, mode="bilinear", padding_mode="border", align_corners=False
        )
        return found[:, :, 0].mT.unflatten(1, points.shape[1:3])
