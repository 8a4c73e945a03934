"""Cars as Gaussians in the canonical box, decoded in one go from two codes.

The shape code places the Gaussians (offsets to a learned template), the texture code colours them; the shape code
reaches the colours detached, so a recoloured car keeps its shape to the bit and colour errors do not bend it.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.models.encoders import EncoderConfig, build_encoder, load_imagenet
from carstudio.models.gaussian_template import surface_template
from carstudio.models.interface import CategoryModel, Latents, PatchBatch
from carstudio.models.left_views import as_left_views
from carstudio.models.patch_features import POSE_FEATURES, pose_features, tiny_masked_copy
from carstudio.rendering.gaussians.cloud import GaussianCloud, mirrored_light
from carstudio.rendering.gaussians.pinhole import draw_exactly
from carstudio.rendering.gaussians.projection import bake_cloud, project
from carstudio.rendering.gaussians.tiles import TILE_PX
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud, trace_cloud
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Rendering, Segments


@dataclass(frozen=True)
class CarGaussiansConfig:
    """Sizes of the Gaussian model."""

    encoder: EncoderConfig = field(
        default_factory=lambda: EncoderConfig(
            kind="small", side_px=64, pretrained=None, num_features=256, sees_mask=True
        )
    )
    """Photo to features."""
    splatting: SplattingConfig = field(default_factory=SplattingConfig)
    """How rays meet Gaussians."""
    num_splats: int = 512
    """Gaussians of a car."""
    code_size: int = 128
    """Length of each of the two codes (`texture_size`: with what else a texture code tells)."""
    width: int = 256
    """Hidden width of the two decoders."""
    blocks: int = 0
    """Residual blocks of each decoder after its first layer."""
    is_symmetric: bool = True
    """Gaussians come in pairs mirrored in the car's middle plane; colours are free."""
    encodes_left_views: bool = False
    """Photos of right sides are encoded as the left views that they are in a mirror, and colours change sides after
    decoding; a number at the end of the texture code tells the side (1 left, -1 right, between them a mixture)."""
    starts_from_brightness: bool = False
    """Colours start from the mean brightness of the car in the photo, whose logit is a number of the texture code."""
    has_light: bool = False
    """The codes tell how bright the car is from each side, exposure and all (`GaussianCloud.light`)."""
    colour_skip_px: int = 8
    """Side of a tiny copy of the masked crop, added to the texture code by a linear map; 0: none."""
    tint_width: int = 64
    """Rank of the colours' change with the line of sight (spherical harmonics of degree 1); 0: colours are the same
    from everywhere."""
    least_scale: float = 0.01
    """Smallest standard deviation of a Gaussian, canonical units."""
    largest_scale: float = 0.5
    """Largest standard deviation, canonical units."""

    def __post_init__(self) -> None:
        assert not self.is_symmetric or self.num_splats % 2 == 0, "mirrored pairs need an even number of Gaussians"
        assert self.is_symmetric or not self.encodes_left_views, "only mirrored pairs can exchange their colours"
        assert 0 < self.least_scale < self.largest_scale, "scales are positive, the least below the largest"

    @property
    def texture_size(self) -> int:
        """Numbers of a texture code: the code proper, then the side and the brightness where they are told."""
        return self.code_size + self.encodes_left_views + self.starts_from_brightness


class CarGaussians(CategoryModel):
    """Encoder, two codes, two decoders."""

    tile_px = TILE_PX
    chunk_rays = 65_536

    def __init__(self, config: CarGaussiansConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder_side_px = config.encoder.side_px
        self.encoder = build_encoder(config.encoder)
        num_features = config.encoder.num_features + POSE_FEATURES
        self.shape_head = nn.Linear(num_features, config.code_size)
        self.texture_head = nn.Linear(num_features, config.code_size)
        self.shape_norm, self.texture_norm = nn.LayerNorm(config.code_size), nn.LayerNorm(config.code_size)
        if config.colour_skip_px:
            self.colour_skip = nn.Linear(3 * config.colour_skip_px**2, config.code_size)
        self.geometry = GeometryDecoder(config)
        self.colour = ColourDecoder(config)

    def load_pretrained_parts(self) -> str:
        """ImageNet weights for the encoder where the config asks for them and they can be had."""
        return load_imagenet(self.encoder, self.config.encoder)

    def field_parameters(self) -> list[tuple[str, nn.Parameter]]:
        """One number for each number of a Gaussian: template and last biases (0.1 MB; as good as all weights)."""
        template = ["geometry.mean", "geometry.scale", "geometry.quaternion", "geometry.opacity"]
        own = {*template, "geometry.offsets.bias", "colour.colours.bias", "colour.tint.1.bias"}
        return [(name, parameter) for name, parameter in self.named_parameters() if name in own]

    def template_parameters(self) -> tuple[nn.Parameter, ...]:
        """The same numbers: what all cars have in common."""
        return tuple(parameter for _, parameter in self.field_parameters())

    def colour_parameters(self) -> list[tuple[str, nn.Parameter]]:
        """The last biases of the colour decoder."""
        return [(name, parameter) for name, parameter in self.field_parameters() if name.startswith("colour.")]

    def encode(self, patches: PatchBatch) -> Latents:
        """Codes of shape and texture."""
        if self.config.encodes_left_views:
            patches, side = as_left_views(patches)
        features = torch.cat([self.encoder(patches), pose_features(patches)], dim=-1)
        texture = self.texture_head(features)
        if self.config.colour_skip_px:
            texture = texture + self.colour_skip(tiny_masked_copy(patches, self.config.colour_skip_px))
        shape, texture = self.shape_norm(self.shape_head(features)), self.texture_norm(texture)
        if self.config.encodes_left_views:
            texture = torch.cat([texture, side[:, None].to(texture)], dim=-1)
        if self.config.starts_from_brightness:
            texture = torch.cat([texture, brightness_logit(patches)[:, None].to(texture)], dim=-1)
        return Latents(shape, texture)

    def decode(self, latents: Latents) -> GaussianCloud:
        """The car's Gaussians in the canonical frame."""
        mean, log_scale, quaternion, opacity = self.geometry(latents.shape)
        further = [1] * (self.config.texture_size - self.config.code_size)
        code, *rest = latents.texture.split([self.config.code_size, *further], dim=-1)
        level = rest.pop() if self.config.starts_from_brightness else None
        rgb, tint, light = self.colour(latents.shape, code, level)
        if self.config.encodes_left_views:
            rgb, tint, light = exchanged(rgb, tint, light, rest.pop()[:, 0])
        return GaussianCloud(mean, log_scale, quaternion, opacity, rgb, tint, light)

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        """The Gaussians along each ray, one level; nothing is random."""
        with torch.autocast(rays.directions.device.type, enabled=False):
            cloud = self.decode(_exact(latents, rays))
            return (trace_cloud(cloud, rays, to_canonical(rays, box), self.config.splatting),)

    def render_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Rendering, ...]:
        """The composite of `trace_levels`, by the shorter way."""
        with torch.autocast(rays.directions.device.type, enabled=False):
            cloud = self.decode(_exact(latents, rays))
            return (render_cloud(cloud, rays, to_canonical(rays, box), self.config.splatting),)

    def draw(self, camera: Camera, latents: Latents, box: Box3D) -> Float[Tensor, "height width 5"] | None:
        """On a CPU, in single precision; see `rendering.gaussians.pinhole`."""
        like = camera.intrinsics
        if like.device.type != "cpu" or like.dtype != torch.float32 or self.config.splatting.is_reference:
            return None
        with torch.autocast("cpu", enabled=False):
            cloud = self.decode(Latents(latents.shape.float(), latents.texture.float()))
        splatting = self.config.splatting
        seen = project(bake_cloud(cloud), camera, box, widen=splatting.widen)
        image = draw_exactly(seen, camera.width, camera.height, most=splatting.most)
        return None if image is None else torch.from_numpy(image)


Colours = tuple[
    Float[Tensor, "batch splat 3"], Float[Tensor, "batch splat 3 3"] | None, Float[Tensor, "batch 9 3"] | None
]


def exchanged(
    rgb: Float[Tensor, "batch splat 3"],
    tint: Float[Tensor, "batch splat 3 3"] | None,
    light: Float[Tensor, "batch 9 3"] | None,
    side: Float[Tensor, " batch"],
) -> Colours:
    """Colours, tint and light as they are for side 1, those of the mirror twins for side -1, mixed in between.

    A Gaussian's twin stands half the number of Gaussians further on; its tint sees a line of sight mirrored in z. A fit
    may move the side a little beyond: colours stay in [0, 1].
    """
    share, half = ((1 + side) / 2)[:, None, None], rgb.shape[1] // 2
    rgb = torch.lerp(rgb.roll(half, dims=1), rgb, share).clamp(0, 1)
    if tint is not None:
        twins = tint.roll(half, dims=1) * tint.new_tensor([1.0, 1.0, -1.0])
        tint = torch.lerp(twins, tint, share[..., None])
    if light is not None:
        light = torch.lerp(mirrored_light(light), light, share)
    return rgb, tint, light


def brightness_logit(patches: PatchBatch) -> Float[Tensor, " batch"]:
    """Logit of the mean of the car's pixels over all channels, that of 1/2 where the mask is empty."""
    mask = patches.mask[:, None]
    count = 3 * mask.sum(dim=(1, 2, 3))
    mean = torch.where(count > 0, (patches.image * mask).sum(dim=(1, 2, 3)) / count.clamp(min=1), 0.5)
    return torch.logit(mean.clamp(0.02, 0.98))


def _exact(latents: Latents, rays: Rays) -> Latents:
    """Codes in the rays' precision: places of Gaussians do not bear bfloat16."""
    return Latents(latents.shape.to(rays.directions.dtype), latents.texture.to(rays.directions.dtype))


def _hidden_layers(num_inputs: int, config: CarGaussiansConfig) -> nn.Sequential:
    """From a code to what the last layers of a decoder are linear in."""
    blocks = [ResidualLayers(config.width) for _ in range(config.blocks)]
    return nn.Sequential(nn.Linear(num_inputs, config.width), nn.SiLU(), *blocks)


class ResidualLayers(nn.Module):
    """x + f(x) with two linear layers, twice as wide between them; f starts at 0."""

    def __init__(self, width: int) -> None:
        super().__init__()
        last = nn.Linear(2 * width, width)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.change = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), last)

    def forward(self, x: Float[Tensor, "batch width"]) -> Float[Tensor, "batch width"]:
        """As the class says."""
        return x + self.change(x)


OFFSETS = {"mean": 3, "log_scale": 3, "quaternion": 4, "opacity": 1}


class GeometryDecoder(nn.Module):
    """Shape code to means, scales, rotations and opacities: a learned template plus offsets."""

    def __init__(self, config: CarGaussiansConfig) -> None:
        super().__init__()
        self.config = config
        count = config.num_splats // 2 if config.is_symmetric else config.num_splats
        self.hidden = _hidden_layers(config.code_size, config)
        self.offsets = nn.Linear(config.width, count * sum(OFFSETS.values()))
        nn.init.normal_(self.offsets.weight, std=0.02 / config.width**0.5)
        nn.init.zeros_(self.offsets.bias)
        template = surface_template(count, is_half=config.is_symmetric)
        span = torch.tensor(config.largest_scale / config.least_scale).log()
        scale = (template.log_scale - torch.tensor(config.least_scale).log()) / span
        self.mean = nn.Parameter(torch.atanh(template.mean))
        self.scale = nn.Parameter(torch.logit(scale.clamp(0.02, 0.98)))
        self.quaternion = nn.Parameter(template.quaternion)
        self.opacity = nn.Parameter(torch.full((count,), 1.0))

    def forward(
        self, shape: Float[Tensor, "batch code"]
    ) -> tuple[
        Float[Tensor, "batch splat 3"],
        Float[Tensor, "batch splat 3"],
        Float[Tensor, "batch splat 4"],
        Float[Tensor, "batch splat"],
    ]:
        """Means, log scales, quaternions and opacities."""
        offsets = self.offsets(self.hidden(shape)).unflatten(-1, (-1, sum(OFFSETS.values())))
        mean, scale, quaternion, opacity = offsets.split(list(OFFSETS.values()), dim=-1)
        mean = torch.tanh(self.mean + mean)
        least, largest = self.mean.new_tensor([self.config.least_scale, self.config.largest_scale]).log()
        log_scale = least + (largest - least) * torch.sigmoid(self.scale + scale)
        quaternion = nn.functional.normalize(self.quaternion + quaternion, dim=-1)
        opacity = torch.sigmoid(self.opacity + opacity.squeeze(-1))
        if self.config.is_symmetric:
            half = GaussianCloud(mean, log_scale, quaternion, opacity, mean)
            other = half.mirrored()
            mean, quaternion = torch.cat([mean, other.mean], dim=1), torch.cat([quaternion, other.quaternion], dim=1)
            log_scale, opacity = torch.cat([log_scale, log_scale], dim=1), torch.cat([opacity, opacity], dim=1)
        return mean, log_scale, quaternion, opacity


class ColourDecoder(nn.Module):
    """Texture code (and the detached shape code) to a colour per Gaussian, and to the light."""

    def __init__(self, config: CarGaussiansConfig) -> None:
        super().__init__()
        self.config = config
        self.hidden = _hidden_layers(2 * config.code_size, config)
        self.colours = nn.Linear(config.width, config.num_splats * 3)
        if config.tint_width:
            last = nn.Linear(config.tint_width, config.num_splats * 9)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
            self.tint = nn.Sequential(nn.Linear(config.width, config.tint_width), last)
        if config.has_light:
            self.light = nn.Linear(config.width, 27)
            nn.init.zeros_(self.light.weight)
            nn.init.zeros_(self.light.bias)

    def forward(
        self,
        shape: Float[Tensor, "batch code"],
        texture: Float[Tensor, "batch code"],
        level: Float[Tensor, "batch 1"] | None,
    ) -> Colours:
        """Colours in [0, 1], their change with the line of sight and the light where the config asks for them.

        `level` is added to the logits of all colours.
        """
        hidden = self.hidden(torch.cat([texture, shape.detach()], dim=-1))
        logits = self.colours(hidden)
        colours = torch.sigmoid(logits if level is None else logits + level).unflatten(-1, (-1, 3))
        tint = self.tint(hidden).unflatten(-1, (-1, 3, 3)) if self.config.tint_width else None
        light = self.light(hidden).unflatten(-1, (9, 3)) if self.config.has_light else None
        return colours, tint, light
