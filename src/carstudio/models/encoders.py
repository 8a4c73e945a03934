"""Image encoders: photo crops to one feature vector per car (Car-Studio section III-C).

`resnet34` is the paper's: ResNet-34 from transformers, features of the stem and the first three stages up-sampled to
the stem's size, concatenated (64 + 64 + 128 + 256 = 512 channels) and max-pooled. `small` is for CPUs.
"""

import logging
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.errors import InputError
from carstudio.hub import load_from_hub
from carstudio.models.box_faces import CHANNELS, box_faces
from carstudio.models.interface import PatchBatch

logger = logging.getLogger(__name__)

RESNET34_HUB_NAME = "microsoft/resnet-34"
SMALL_CHANNELS = (32, 64, 96, 128)
SMALL_PYRAMID_FEATURES = sum(SMALL_CHANNELS)
DEPTHS, WIDTHS = [3, 4, 6, 3], [64, 128, 256, 512]  # of ResNet-34


@dataclass(frozen=True)
class EncoderConfig:
    """Which encoder turns the crop into features."""

    kind: Literal["resnet34", "small", "small-pyramid", "box-faces"] = "resnet34"
    """"resnet34": the paper's; "small": a few convolutions, 4 ms a patch on one core; "small-pyramid": as resnet34 is
    built, stages up-sampled and joined, of a few convolutions (small rows of the tables); "box-faces": a few
    convolutions on the photo laid out on the faces of the car's box, which always sees the mask."""
    side_px: int = 128
    """Side of the square the crop is resized to (released: 128)."""
    pretrained: str | None = RESNET34_HUB_NAME
    """Hub name or folder of ImageNet weights for resnet34; None: start from random weights."""
    num_features: int = 512
    """Length of the feature vector (512 for resnet34 and 320 for small-pyramid, fixed)."""
    sees_mask: bool = False
    """Also feed the mask as a fourth channel ("small"; the paper's encoder sees the photo alone)."""
    stem_px: Literal[2, 4] = 2
    """What "box-faces" does first: 2: two convolutions that halve the side each; 4: one of 4 x 4 px that do not
    overlap, in two thirds of the encoder's time."""

    def __post_init__(self) -> None:
        if self.kind == "resnet34":
            assert self.num_features == 512, "resnet34 gives 512 features"
            assert not self.sees_mask, "resnet34 sees the photo alone"
        if self.kind == "small-pyramid":
            assert self.num_features == SMALL_PYRAMID_FEATURES, "small-pyramid gives 320 features"
            assert not self.sees_mask, "small-pyramid sees the photo alone"
        if self.kind == "box-faces":
            assert self.sees_mask, "box-faces sees the mask"
            assert self.side_px % 2 ** len(SMALL_CHANNELS) == 0, "box-faces needs a side of a multiple of 16 px"


class ResNet34Encoder(nn.Module):
    """The paper's encoder; 512 features."""

    def __init__(self) -> None:
        super().__init__()
        from transformers import ResNetConfig, ResNetModel

        config = ResNetConfig(depths=DEPTHS, hidden_sizes=WIDTHS, layer_type="basic")
        backbone = ResNetModel(config)
        self.embedder = backbone.embedder.embedder  # conv1 + batch norm + relu
        self.pool = nn.MaxPool2d(kernel_size=3, stride=2, padding=1)
        self.stages = nn.ModuleList(backbone.encoder.stages[:3])

    def load_pretrained(self, name: str) -> None:
        """Weights from the hub or a folder; OSError when there are none, `InputError` when they are no ResNet-34."""
        from transformers import AutoConfig, ResNetModel

        found = load_from_hub(AutoConfig.from_pretrained, name)
        sizes = [getattr(found, key, None) for key in ("model_type", "depths", "hidden_sizes", "layer_type")]
        if sizes != ["resnet", DEPTHS, WIDTHS, "basic"]:
            raise InputError(
                f"{name}: expected a ResNet-34 (resnet, depths {DEPTHS}, widths {WIDTHS}, basic layers), found "
                f"{sizes}; name another one or None for random weights"
            )
        loaded = load_from_hub(ResNetModel.from_pretrained, name)
        self.embedder.load_state_dict(loaded.embedder.embedder.state_dict())
        for ours, theirs in zip(self.stages, loaded.encoder.stages[:3], strict=True):
            ours.load_state_dict(theirs.state_dict())

    def forward(self, patches: PatchBatch) -> Float[Tensor, "batch 512"]:
        """Global features: the map's maxima. The mask is ignored, as in the paper."""
        return self.feature_map(patches.image).amax(dim=(-2, -1))

    def feature_map(self, image: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch 512 rows columns"]:
        """Features at half the photo's resolution, for models that look up single pixels."""
        stem = self.embedder((image - 0.5) / 0.5)
        features, maps = self.pool(stem), [stem]
        for stage in self.stages:
            features = stage(features)
            maps.append(features)
        return joined(maps)


def joined(maps: list[Tensor]) -> Float[Tensor, "batch feature rows columns"]:
    """Maps up-sampled to the first one's size and joined (PixelNeRF: bilinear, the corners' centres aligned)."""
    size = maps[0].shape[-2:]
    resized = [nn.functional.interpolate(m, size, mode="bilinear", align_corners=True) for m in maps]
    return torch.cat(resized, dim=1)


class SmallPyramid(nn.Module):
    """The paper's encoder in small: four strided convolutions, their maps joined; 320 features."""

    def __init__(self) -> None:
        super().__init__()
        pairs = pairwise((3, *SMALL_CHANNELS))
        self.stages = nn.ModuleList(
            nn.Sequential(nn.Conv2d(inside, outside, 3, stride=2, padding=1), nn.GroupNorm(8, outside), nn.SiLU())
            for inside, outside in pairs
        )

    def forward(self, patches: PatchBatch) -> Float[Tensor, "batch feature"]:
        """Global features: the map's maxima. The mask is ignored."""
        return self.feature_map(patches.image).amax(dim=(-2, -1))

    def feature_map(self, image: Float[Tensor, "batch 3 side side"]) -> Float[Tensor, "batch feature rows columns"]:
        """Features at half the photo's resolution."""
        maps = [(image - 0.5) / 0.5]
        for stage in self.stages:
            maps.append(stage(maps[-1]))
        return joined(maps[1:])


class SmallEncoder(nn.Module):
    """Strided convolutions with group norm down to 4 x 4, then one linear map: keeps where things are in the crop."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        shrinking = _shrinking(4 if config.sees_mask else 3, *SMALL_CHANNELS)
        self.convolutions = nn.Sequential(*shrinking, nn.AdaptiveAvgPool2d(4), nn.Flatten())
        self.linear = nn.Linear(SMALL_CHANNELS[-1] * 16, config.num_features)
        self.sees_mask = config.sees_mask

    def forward(self, patches: PatchBatch) -> Float[Tensor, "batch feature"]:
        """Features of the crop (and of the mask where the config says so)."""
        pixels = (patches.image - 0.5) / 0.5
        if self.sees_mask:
            pixels = torch.cat([pixels, patches.mask[:, None]], dim=1)
        return nn.functional.silu(self.linear(self.convolutions(pixels)))


class BoxFacesEncoder(nn.Module):
    """The same on the photo laid out on the faces of the box, with a residual block at the end."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.side_px = config.side_px
        last = SMALL_CHANNELS[-1]
        shrinking = _shrinking(CHANNELS, *SMALL_CHANNELS) if config.stem_px == 2 else _shrinking_from_patches(CHANNELS)
        self.convolutions = nn.Sequential(*shrinking, ResidualConvolutions(last), nn.Flatten())
        self.linear = nn.Linear(last * (config.side_px // 2 ** len(SMALL_CHANNELS)) ** 2, config.num_features)

    def forward(self, patches: PatchBatch) -> Float[Tensor, "batch feature"]:
        """Features of the faces that the camera sees."""
        return nn.functional.silu(self.linear(self.convolutions(box_faces(patches, self.side_px))))


def _shrinking(*channels: int) -> list[nn.Module]:
    """Convolutions that halve the side each, from and to so many channels."""
    layers: list[nn.Module] = []
    for inside, outside in pairwise(channels):
        layers += [nn.Conv2d(inside, outside, 3, stride=2, padding=1), nn.GroupNorm(8, outside), nn.SiLU()]
    return layers


def _shrinking_from_patches(channels: int) -> list[nn.Module]:
    """The same size at the end, the first two convolutions replaced by one of patches."""
    width = SMALL_CHANNELS[1]
    stem = [nn.Conv2d(channels, width, 4, stride=4), nn.GroupNorm(8, width), nn.SiLU()]
    return [*stem, *_shrinking(*SMALL_CHANNELS[1:])]


class ResidualConvolutions(nn.Module):
    """x + f(x) with two convolutions; f starts at 0."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.change = nn.Sequential(
            *(nn.GroupNorm(8, channels), nn.SiLU(), nn.Conv2d(channels, channels, 3, padding=1)),
            *(nn.GroupNorm(8, channels), nn.SiLU(), nn.Conv2d(channels, channels, 3, padding=1)),
        )
        last = self.change[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, x: Float[Tensor, "batch channel rows columns"]) -> Float[Tensor, "batch channel rows columns"]:
        """As the class says."""
        return x + self.change(x)


def build_encoder(config: EncoderConfig) -> nn.Module:
    """The encoder a config names, with random weights (`load_imagenet` replaces them)."""
    if config.kind == "resnet34":
        return ResNet34Encoder()
    if config.kind == "small-pyramid":
        return SmallPyramid()
    return BoxFacesEncoder(config) if config.kind == "box-faces" else SmallEncoder(config)


def load_imagenet(encoder: nn.Module, config: EncoderConfig) -> str:
    """Load ImageNet weights where the config asks for them; says in words what the encoder now starts from."""
    if not isinstance(encoder, ResNet34Encoder) or config.pretrained is None:
        return "random weights"
    try:
        encoder.load_pretrained(config.pretrained)
    except OSError as error:
        message = f"random weights ({config.pretrained} is not on this machine and cannot be downloaded)"
        logger.warning("encoder: %s: %s", message, str(error).splitlines()[0])
        return message
    return f"ImageNet weights of {config.pretrained}"
