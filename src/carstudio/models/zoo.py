"""Which models there are: the name in a checkpoint, its config and its class."""

import dataclasses
from typing import Any

from pydantic import TypeAdapter, ValidationError

from carstudio.errors import InputError
from carstudio.models.autorf import AutoRF, AutoRFConfig
from carstudio.models.car_gaussians import CarGaussians, CarGaussiansConfig
from carstudio.models.car_nerf import CarNeRF, CarNeRFConfig
from carstudio.models.code_nerf import CodeNeRF, CodeNeRFConfig
from carstudio.models.interface import CategoryModel
from carstudio.models.nsg import NSG, NSGConfig
from carstudio.models.pixel_nerf import PixelNeRF, PixelNeRFConfig

ModelConfig = CarNeRFConfig | CarGaussiansConfig | AutoRFConfig | PixelNeRFConfig | CodeNeRFConfig | NSGConfig

MODELS: dict[str, tuple[type[Any], type[CategoryModel]]] = {
    "car-nerf": (CarNeRFConfig, CarNeRF),
    "car-gaussians": (CarGaussiansConfig, CarGaussians),
    "autorf": (AutoRFConfig, AutoRF),
    "pixelnerf": (PixelNeRFConfig, PixelNeRF),
    "code-nerf": (CodeNeRFConfig, CodeNeRF),
    "nsg": (NSGConfig, NSG),
}


def with_cars(config: ModelConfig, instance_ids: tuple[str, ...]) -> ModelConfig:
    """The config told which cars it is trained on, where its model keeps a code for each (a field `cars`)."""
    if "cars" not in {field.name for field in dataclasses.fields(config)}:
        return config
    changes: dict[str, Any] = {"cars": instance_ids}
    return dataclasses.replace(config, **changes)


def build_model(config: ModelConfig) -> CategoryModel:
    """A model with fresh random weights (torch's global generator)."""
    for config_class, model_class in MODELS.values():
        if type(config) is config_class:
            return model_class(config)
    raise AssertionError(f"no model for {type(config).__name__}")


def config_to_json(config: ModelConfig) -> dict[str, Any]:
    """`{"kind": name, ...fields}`, plain JSON values."""
    kind = next(name for name, (config_class, _) in MODELS.items() if type(config) is config_class)
    return {"kind": kind, **dataclasses.asdict(config)}


def config_from_json(value: Any, *, name: str) -> ModelConfig:
    """Inverse of `config_to_json`; `InputError` naming the file for unknown kinds, unknown fields and wrong types."""
    kind = value.get("kind") if isinstance(value, dict) else value
    if not isinstance(kind, str) or kind not in MODELS:
        raise InputError(f"{name}: model kind must be one of {sorted(MODELS)}, found {kind!r}")
    config_class, _ = MODELS[kind]
    fields = {key: field for key, field in value.items() if key != "kind"}
    return parse_dataclass(config_class, fields, name=name)


def parse_dataclass(config_class: type[Any], fields: Any, *, name: str) -> Any:
    """A (nested) config dataclass from JSON values, checked field by field."""
    unknown = _unknown_fields(config_class, fields)
    if unknown:
        raise InputError(f"{name}: unknown fields {unknown} of {config_class.__name__}; written by a newer version?")
    try:
        return TypeAdapter(config_class).validate_python(fields)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{name}: field {where!r}: {first['msg']}, found {first.get('input')!r}") from error


def _unknown_fields(config_class: type[Any], fields: Any, prefix: str = "") -> list[str]:
    if not isinstance(fields, dict):
        return []
    known = {field.name: field.type for field in dataclasses.fields(config_class)}
    unknown = [prefix + key for key in fields if key not in known]
    for key, kind in known.items():
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            unknown += _unknown_fields(kind, fields.get(key), f"{prefix}{key}.")
    return unknown
