"""The pretrained networks that Car-Studio knows by name: what each is for, its licence, what it costs to download.

Sizes are those of the files that are fetched (config, preprocessor, safetensors), as the hub lists them.
"""

from dataclasses import dataclass

from carstudio.errors import InputError

DEFAULT_DETECTOR = "ustc-community/dfine-medium-obj2coco"
"""D-FINE-M (Peng et al., ICLR 2025), trained on Objects365, then on COCO; Apache-2.0. Published COCO val AP, parameters
and operations (the authors' tables): D-FINE-M 55.0 AP, 19 M, 57 GFLOPs; D-FINE-S 50.3 AP, 10 M, 25 GFLOPs (for slow
CPUs); D-FINE-L 56.9 AP, 31 M, 91 GFLOPs; RT-DETRv2-S 48.1 AP, 20 M; RT-DETRv2-L 53.4 AP, 42 M; RT-DETRv2-X 54.3 AP,
76 M. So it is more exact than the largest RT-DETRv2 with a quarter of its weights. Its strength, refined box edges, is
what the 2-D box filter and SAM's prompt live on."""
DEFAULT_SAM = "facebook/sam-vit-huge"
"""What the released CarPatch3D was cut out with. facebook/sam-vit-base is a seventh of its size."""
DEFAULT_SAM2 = "facebook/sam2.1-hiera-large"
"""A third of SAM ViT-H's weights, and its successor; the smaller ones for CPUs."""
RESNET34 = "microsoft/resnet-34"
"""ImageNet weights of the paper's encoder."""


@dataclass(frozen=True)
class KnownModel:
    """A model of the hub."""

    name: str
    spec: str
    """What to write in an option; {} stands for the name, or a folder it was downloaded to."""
    purpose: str
    licence: str
    megabytes: int
    """10^6 bytes to download."""

    @property
    def short_name(self) -> str:
        """The name without its owner."""
        return self.name.rpartition("/")[2]


ENCODER_OPTION = "--model.encoder.pretrained {}"
_DETECT, _SAM, _SAM2 = "--detector transformers:{}", "--segmenter sam:{}", "--segmenter sam2:{}"
KNOWN_MODELS = (
    KnownModel(DEFAULT_DETECTOR, _DETECT, "2-D boxes of vehicles (default)", "Apache-2.0", 79),
    KnownModel("ustc-community/dfine-small-obj2coco", _DETECT, "2-D boxes, for slow CPUs", "Apache-2.0", 42),
    KnownModel("PekingU/rtdetr_v2_r50vd", _DETECT, "2-D boxes, RT-DETRv2-L", "Apache-2.0", 172),
    KnownModel(DEFAULT_SAM, _SAM, "masks, as the released data set (default)", "Apache-2.0", 2560),
    KnownModel("facebook/sam-vit-large", _SAM, "masks, SAM of half the size", "Apache-2.0", 1250),
    KnownModel("facebook/sam-vit-base", _SAM, "masks, the smallest SAM", "Apache-2.0", 375),
    KnownModel(DEFAULT_SAM2, _SAM2, "masks by SAM 2 (default)", "Apache-2.0", 898),
    KnownModel("facebook/sam2.1-hiera-base-plus", _SAM2, "masks, SAM 2 of a third of the size", "Apache-2.0", 323),
    KnownModel("facebook/sam2.1-hiera-small", _SAM2, "masks, a small SAM 2", "Apache-2.0", 184),
    KnownModel("facebook/sam2.1-hiera-tiny", _SAM2, "masks, the smallest SAM 2", "Apache-2.0", 156),
    KnownModel(RESNET34, ENCODER_OPTION, "start of the paper's image encoder", "Apache-2.0", 87),
)


def full_name(name: str) -> str:
    """The hub's name of a model that may be written without its owner; `InputError` when we know none such."""
    if "/" in name:
        return name
    for model in KNOWN_MODELS:
        if name == model.short_name:
            return model.name
    known = ", ".join(model.short_name for model in KNOWN_MODELS)
    raise InputError(f"model {name!r}: expected OWNER/MODEL as on the hub, or one of {known}")


def option_for(name: str, place: str) -> str | None:
    """The option that uses a known model, with `place` (its name or folder) written in; None: not one of ours."""
    for model in KNOWN_MODELS:
        if model.name == name:
            return model.spec.format(place)
    return None
