"""A car on disk: `car.safetensors` (latents, and weights where fitting changed them) + `car.json`.

The model itself is not in it: `car.json` has its name and the sha256 of its weights, and a car is only ever shown by
that very model.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from carstudio.errors import InputError
from carstudio.files import read_json, sha256_file, write_json
from carstudio.models.interface import CategoryModel, Latents
from carstudio.tensors import load_tensors, save_tensors

TENSORS, DESCRIPTION = "car.safetensors", "car.json"
FORMAT, FORMAT_VERSION = "carstudio-car", 1
MOST_M = 30.0  # a longer car is no car
_WEIGHT = "model."


@dataclass(frozen=True)
class Car:
    """One car. `latents` are a batch of one; `size` is length, height, width in metres."""

    latents: Latents
    size: tuple[float, float, float]
    model_name: str
    model_sha256: str
    instance_id: str
    licence: str
    weights: dict[str, torch.Tensor] = field(default_factory=dict)  # those of the model that fitting changed
    provenance: dict[str, Any] = field(default_factory=dict)


def save_car(folder: Path, car: Car) -> None:
    """Write the two files; the description, with the tensors' checksum, last."""
    assert len(car.latents.shape) == 1, "a file holds one car"
    tensors = {"shape": car.latents.shape, "texture": car.latents.texture}
    save_tensors(folder / TENSORS, tensors | {f"{_WEIGHT}{name}": value for name, value in car.weights.items()})
    length, height, width = car.size
    value = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "instance_id": car.instance_id,
        "size_m": {"length": length, "height": height, "width": width},
        "model": {"name": car.model_name, "sha256": car.model_sha256},
        "licence": car.licence,
        "provenance": car.provenance,
        "sha256": sha256_file(folder / TENSORS),
    }
    write_json(folder / DESCRIPTION, value)


def load_car(folder: Path | str) -> Car:
    """Read and check a car; `InputError` names the file and what is wrong."""
    folder = Path(folder)
    path = folder / DESCRIPTION
    if not path.exists():
        raise InputError(f"{folder}: expected a car ({DESCRIPTION} and {TENSORS}), found none; see `carstudio fit`")
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT or value.get("format_version") != FORMAT_VERSION:
        raise InputError(f"{path}: expected format {FORMAT}, version {FORMAT_VERSION}; update carstudio, or fit again")
    size, model = value.get("size_m"), value.get("model")
    if not isinstance(size, dict) or not all(_is_length(size.get(side)) for side in ("length", "height", "width")):
        raise InputError(f"{path}: size_m must have length, height and width in metres (0 to {MOST_M:g}), found {size}")
    if not isinstance(model, dict) or not all(isinstance(model.get(key), str) for key in ("name", "sha256")):
        raise InputError(f"{path}: model must have a name and a sha256, found {model}")
    texts = {key: value.get(key) for key in ("instance_id", "licence", "sha256")}
    if not all(isinstance(text, str) for text in texts.values()) or not isinstance(value.get("provenance"), dict):
        raise InputError(f"{path}: instance_id, licence and sha256 must be texts and provenance an object")
    tensors = load_tensors(folder / TENSORS)
    if sha256_file(folder / TENSORS) != texts["sha256"]:
        raise InputError(f"{folder / TENSORS}: sha256 differs from the one in {DESCRIPTION}; fit the car again")
    return Car(
        latents=Latents(_code(tensors, "shape", folder), _code(tensors, "texture", folder)),
        size=(float(size["length"]), float(size["height"]), float(size["width"])),
        model_name=model["name"],
        model_sha256=model["sha256"],
        instance_id=str(texts["instance_id"]),
        licence=str(texts["licence"]),
        weights={key.removeprefix(_WEIGHT): t for key, t in tensors.items() if key.startswith(_WEIGHT)},
        provenance=value["provenance"],
    )


def put_weights(model: CategoryModel, car: Car, *, name: str) -> None:
    """Give the model the weights that fitting changed; `InputError` when they are not its own."""
    known = model.state_dict()
    for key, tensor in car.weights.items():
        if key not in known or known[key].shape != tensor.shape:
            raise InputError(f"{name}: has weights of another model ({key}); show it with the model it was fitted with")
    model.load_state_dict(car.weights, strict=False)


def _is_length(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= MOST_M


def _code(tensors: dict[str, torch.Tensor], name: str, folder: Path) -> torch.Tensor:
    code = tensors.get(name)
    if code is None or code.dim() != 2 or len(code) != 1 or not bool(torch.isfinite(code).all()):
        raise InputError(f"{folder / TENSORS}: {name} must be one row of finite numbers; fit the car again")
    return code.float()
