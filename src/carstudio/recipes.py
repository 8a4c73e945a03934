"""Named recipes: functions that return a whole training config. Variants come by `dataclasses.replace`."""

from collections.abc import Callable
from dataclasses import replace

from carstudio.errors import InputError
from carstudio.models.autorf import AutoRFConfig
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.models.car_nerf import CarNeRFConfig
from carstudio.models.code_nerf import CodeNeRFConfig
from carstudio.models.encoders import EncoderConfig
from carstudio.models.nsg import NSGConfig
from carstudio.models.pixel_nerf import PixelNeRFConfig
from carstudio.rendering.field import SamplingConfig
from carstudio.rendering.gaussians.tracing import SplattingConfig
from carstudio.training.batches import Supervision
from carstudio.training.config import TrainConfig
from carstudio.training.losses import LossConfig
from carstudio.training.schedule import ScheduleConfig


def car_nerf() -> TrainConfig:
    """Car-NeRF at paper size: ResNet-34, 8 x 256, 128 + 128 samples, masked colour and mask loss, 500k steps."""
    return TrainConfig()


def car_nerf_no_mask() -> TrainConfig:
    """The paper's row without mask loss: colour over the whole crop, the background against black."""
    return replace(car_nerf(), recipe="car-nerf-no-mask", loss=LossConfig(colour="whole-crop", mask_weight=0.0))


def car_nerf_as_released() -> TrainConfig:
    """Car-NeRF with the released code's encoding, cone and whole-crop colour loss, for comparing."""
    model = CarNeRFConfig(released_encoding=True, sampling=SamplingConfig(cone_map="isotropic-as-released"))
    return replace(car_nerf(), recipe="car-nerf-as-released", model=model, loss=LossConfig(colour="whole-crop"))


def car_nerf_small() -> TrainConfig:
    """Car-NeRF for a laptop's CPU: 4 x 128, small encoder, normalised codes, 8 x 8 colour skip, clipped gradients."""
    model = CarNeRFConfig(
        encoder=EncoderConfig(kind="small", side_px=64, pretrained=None, num_features=256, sees_mask=True),
        sampling=SamplingConfig(coarse=20, fine=0),
        width=128,
        depth=4,
        skip_after=None,
        position_frequencies=8,
        direction_frequencies=2,
        normalise_codes=True,
        colour_skip_px=8,
        encode_pose=True,
    )
    return TrainConfig(
        recipe="car-nerf-small",
        model=model,
        loss=LossConfig(colour="whole-crop"),
        schedule=ScheduleConfig(first=5e-3, last=1e-4, decay_steps=None, warmup_steps=100),
        supervision="mixed",
        patches_per_step=32,
        rays_per_patch=64,
        precision="auto",
        steps=4_000,
        clip_gradient=1.0,
    )


def car_gaussians() -> TrainConfig:
    """Gaussians in the car's box, for quality: 1,024 in mirrored pairs, photos laid out on the box's faces."""
    encoder = EncoderConfig(kind="box-faces", side_px=64, stem_px=4, pretrained=None, num_features=256, sees_mask=True)
    return TrainConfig(
        recipe="car-gaussians",
        model=CarGaussiansConfig(
            encoder=encoder,
            splatting=SplattingConfig(most=48),
            num_splats=1024,
            code_size=256,
            width=512,
            blocks=1,
            encodes_left_views=True,
            starts_from_brightness=True,
            has_light=True,
        ),
        loss=LossConfig(colour="whole-crop", mask_weight=0.3, exposed_share=0.5, photo_error="log"),
        schedule=ScheduleConfig(first=6e-4, last=6e-6, decay="linear", decay_steps=None, warmup_steps=100),
        optimizer="adam",
        second_moment=0.99,
        template_rate=10.0,
        supervision="mixed",
        mirroring="apart-where-alone",
        box_noise=1.0,
        patches_per_step=32,
        rays_per_patch=256,
        pixels="in-cells",
        precision="auto",
        steps=10_000,
        clip_gradient=1.0,
    )


def car_gaussians_preview() -> TrainConfig:
    """The same with 256 Gaussians, for speed: a car to look at after a minute or two."""
    config = car_gaussians()
    assert isinstance(config.model, CarGaussiansConfig)
    model = replace(config.model, num_splats=256, splatting=SplattingConfig(most=24))
    return replace(config, recipe="car-gaussians-preview", model=model, steps=2_000)


def pixelnerf_resnet() -> TrainConfig:
    """PixelNeRF in the box frame: features of the pixel that shows a sample, five residual blocks of 512, rate 1e-4."""
    return replace(
        car_nerf_no_mask(),
        recipe="pixelnerf-resnet",
        model=PixelNeRFConfig(),
        schedule=ScheduleConfig(first=1e-4, last=1e-4),
    )


def pixelnerf_resnet_global() -> TrainConfig:
    """The same with one feature vector per car, as Car-Studio's released code had it."""
    return replace(pixelnerf_resnet(), recipe="pixelnerf-resnet-global", model=PixelNeRFConfig(features="global"))


def pixelnerf_mlp() -> TrainConfig:
    """PixelNeRF's features joined to the input of NeRF's MLP, 8 x 256, 10 and 4 octaves."""
    model = PixelNeRFConfig(
        backbone="mlp",
        width=256,
        depth=8,
        position_frequencies=10,
        frequency_factor=1.0,
        direction_frequencies=4,
        density="softplus",
    )
    return replace(car_nerf_no_mask(), recipe="pixelnerf-mlp", model=model)


def autorf() -> TrainConfig:
    """AutoRF: points instead of cones, 8 x 128, 64 samples in one pass, colour over the whole crop."""
    return replace(car_nerf_no_mask(), recipe="autorf", model=AutoRFConfig())


def autorf_occupancy() -> TrainConfig:
    """AutoRF with the losses of its own paper: colour on the car, and the likelihood of the mask."""
    return replace(autorf(), recipe="autorf-occupancy", loss=LossConfig(mask_error="log"))


def code_nerf() -> TrainConfig:
    """CodeNeRF: a code per car learned with the field, AdamW at 1e-4 for the field and 1e-3 for codes, 96 samples."""
    return replace(
        car_nerf_no_mask(),
        recipe="code-nerf",
        model=CodeNeRFConfig(),
        loss=LossConfig(colour="whole-crop", mask_weight=0.0, code_weight=1e-4),
        schedule=ScheduleConfig(first=1e-4, last=1e-4),
        optimizer="adamw",
        code_rate=10.0,
    )


def nsg() -> TrainConfig:
    """NSG's object model with the original's knobs: 7 samples, a box 1.9 times as long and wide, the place known."""
    return replace(
        car_nerf(),
        recipe="nsg",
        model=NSGConfig(),
        schedule=ScheduleConfig(first=5e-4, last=5e-5, decay_steps=250_000),
        optimizer="adam",
    )


def nsg_fair() -> TrainConfig:
    """NSG's object model with 64 samples a ray and without the place."""
    model = NSGConfig(sampling=SamplingConfig(coarse=64, fine=0), sees_place=False)
    return replace(nsg(), recipe="nsg-fair", model=model)


RECIPES: dict[str, Callable[[], TrainConfig]] = {
    "car-nerf": car_nerf,
    "car-nerf-no-mask": car_nerf_no_mask,
    "car-nerf-as-released": car_nerf_as_released,
    "car-nerf-small": car_nerf_small,
    "car-gaussians": car_gaussians,
    "car-gaussians-preview": car_gaussians_preview,
    "pixelnerf-resnet": pixelnerf_resnet,
    "pixelnerf-resnet-global": pixelnerf_resnet_global,
    "pixelnerf-mlp": pixelnerf_mlp,
    "autorf": autorf,
    "autorf-occupancy": autorf_occupancy,
    "code-nerf": code_nerf,
    "nsg": nsg,
    "nsg-fair": nsg_fair,
}


def recipe(name: str) -> TrainConfig:
    """The recipe of that name; `InputError` lists the names there are."""
    if name not in RECIPES:
        raise InputError(f"recipe must be one of {', '.join(RECIPES)}, found {name!r}")
    return RECIPES[name]()


def supervised(config: TrainConfig, supervision: Supervision) -> TrainConfig:
    """The recipe with another supervision.

    A model that knows a car as a seen and an unseen side learns nothing of the unseen one from photos that explain
    themselves: with single-view supervision all are shown in the mirror too, as views of the other side.
    """
    is_short = supervision == "single-view" and config.mirroring == "apart-where-alone"
    return replace(config, supervision=supervision, mirroring="apart" if is_short else config.mirroring)
