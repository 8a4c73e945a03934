"""Models on disk: `model.safetensors` + `model.json`; nothing is ever unpickled.

`model.json` holds format version, model config, provenance and the sha256 of the weights beside it. Weights may be
stored as float16 (`halve_model`), as those that come with the package are; a model computes with float32 all the same.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from carstudio.errors import InputError
from carstudio.files import read_json, sha256_file, write_json
from carstudio.models.interface import CategoryModel
from carstudio.models.zoo import ModelConfig, build_model, config_from_json, config_to_json
from carstudio.tensors import load_tensors, save_tensors
from carstudio.training.bundled import bundled_models, find_model

FORMAT_VERSION = 1
WEIGHTS, DESCRIPTION = "model.safetensors", "model.json"
MAX_SIZE = 16_384  # of any whole number in a model's description: sixty times the paper's widest layer
# (least, most) of those that the weights' shapes do not tell, that the number of layers follows, or whose 0 is "none"
LIMITS = {
    "side_px": (8, 1024),
    "coarse": (1, 4096),
    "fine": (0, 4096),
    "depth": (1, 256),
    "skip_after": (0, 256),
    "colour_skip_px": (0, 256),
    "blocks": (0, 64),
    "most": (1, 16_384),
    "tint_width": (0, 16_384),
    "position_frequencies": (1, 32),
    "direction_frequencies": (0, 32),
}


@dataclass(frozen=True)
class ModelDescription:
    """What `model.json` says: the config to build the model from, where it came from, and its weights' checksum."""

    config: ModelConfig
    provenance: dict[str, Any]
    sha256: str


def save_model(folder: Path, model: CategoryModel, config: ModelConfig, provenance: dict[str, Any]) -> str:
    """Write weights, then description; returns the weights' sha256."""
    save_tensors(folder / WEIGHTS, {name: tensor for name, tensor in model.state_dict().items()})
    checksum = sha256_file(folder / WEIGHTS)
    value = {
        "format_version": FORMAT_VERSION,
        "config": config_to_json(config),
        "provenance": provenance,
        "sha256": checksum,
    }
    write_json(folder / DESCRIPTION, value)
    return checksum


def describe_model(folder: Path | str) -> ModelDescription:
    """Read and check `model.json` of a run or model folder, or of a bundled model."""
    folder = find_model(folder)
    path = folder / DESCRIPTION
    if not path.exists():
        raise InputError(
            f"{folder}: expected a trained model ({DESCRIPTION} and {WEIGHTS}), found none; see `train`, or take a "
            f"bundled one: {', '.join(bundled_models()) or 'there is none here'}"
        )
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format_version") != FORMAT_VERSION:
        found = value.get("format_version") if isinstance(value, dict) else value
        raise InputError(f"{path}: expected format_version {FORMAT_VERSION}, found {found!r}; update carstudio")
    config = config_from_json(value.get("config"), name=str(path))
    provenance, checksum = value.get("provenance", {}), value.get("sha256")
    if not isinstance(provenance, dict) or not isinstance(checksum, str) or len(checksum) != 64:
        raise InputError(
            f"{path}: expected a provenance and the weights' sha256, found {checksum!r}; the file is damaged"
        )
    return ModelDescription(config, provenance, checksum)


def load_model(path_or_name: Path | str, *, device: torch.device | str = "cpu") -> CategoryModel:
    """The model of a run folder, or a bundled one by its name, ready to encode, trace and render (evaluation mode)."""
    folder = find_model(path_or_name)
    description = describe_model(folder)
    tensors = _described_tensors(folder, description)
    _check_before_building(description.config, tensors, folder)
    model = build_model(description.config)
    load_weights(model, tensors, name=str(folder / WEIGHTS))
    return model.to(device).eval()


def _described_tensors(folder: Path, description: ModelDescription) -> dict[str, torch.Tensor]:
    """The weights that `model.json` speaks of."""
    tensors = load_tensors(folder / WEIGHTS)
    if sha256_file(folder / WEIGHTS) != description.sha256:
        raise InputError(
            f"{folder / WEIGHTS}: sha256 differs from the one in {DESCRIPTION}; the two do not belong together. "
            "Where a kill cut a checkpoint off, `carstudio train ... --resume` writes both again"
        )
    return tensors


def _check_before_building(config: ModelConfig, tensors: dict[str, torch.Tensor], folder: Path) -> None:
    """Refuse a description whose sizes are absurd, or are not the weights', before memory is taken for them."""
    absurd = _sizes_beyond(config_to_json(config), "config")
    if absurd:
        raise InputError(f"{folder / DESCRIPTION}: {absurd[0]}; the file is damaged or foreign")
    with torch.device("meta"):
        expected = build_model(config).state_dict()
    _check_names_and_shapes(expected, tensors, name=str(folder / WEIGHTS))


def _sizes_beyond(value: Any, name: str) -> list[str]:
    if isinstance(value, dict):
        return [found for key, item in value.items() for found in _sizes_beyond(item, f"{name}.{key}")]
    if not isinstance(value, int) or isinstance(value, bool):
        return []
    least, most = LIMITS.get(name.rpartition(".")[2], (1, MAX_SIZE))
    return [] if least <= value <= most else [f"{name} = {value} must lie between {least} and {most}"]


def halve_model(folder: Path | str, out: Path) -> str:
    """A trained model again with its weights rounded to float16, half the size, to pass on; returns their sha256.

    Rounding moves a weight by 1 in 2,048 of itself at most. `InputError` where `out` holds a model, or a weight is too
    large for float16.
    """
    folder = find_model(folder)
    description = describe_model(folder)
    if (out / DESCRIPTION).exists() or (out / WEIGHTS).exists():
        raise InputError(f"{out} holds a model already; choose another --out")
    model = load_model(folder)
    for name, tensor in model.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.half().isfinite().all()):
            raise InputError(f"{folder}: {name} holds numbers beyond float16's 65,504; keep the model as it is")
    provenance = {**description.provenance, "weights": f"those of sha256 {description.sha256}, rounded to float16"}
    return save_model(out, model.half(), description.config, provenance)


def load_weights_of(folder: Path, model: CategoryModel, config: ModelConfig) -> str:
    """Give `model` the weights of another run of the same model config; says in words what it now starts from."""
    folder = find_model(folder)
    description = describe_model(folder)
    if description.config != config:
        theirs, ours = config_to_json(description.config), config_to_json(config)
        different = [key for key in ours if theirs.get(key) != ours[key]]
        raise InputError(f"{folder}: its model differs from the recipe's in {different}; start from the same recipe")
    load_weights(model, _described_tensors(folder, description), name=str(folder / WEIGHTS))
    return f"weights {description.sha256[:16]} of {folder.name}"


def load_weights(model: torch.nn.Module, tensors: dict[str, torch.Tensor], *, name: str) -> None:
    """`load_state_dict` with an error a user can read: names what is missing, left over or of another shape."""
    _check_names_and_shapes(model.state_dict(), tensors, name=name)
    for key, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise InputError(
                f"{name}: {key} holds numbers that are not finite: its training ran away; use another run, or train "
                "again with a lower --learning-rate"
            )
    model.load_state_dict(tensors)


def _check_names_and_shapes(expected: dict[str, torch.Tensor], tensors: dict[str, torch.Tensor], *, name: str) -> None:
    missing, extra = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or extra:
        raise InputError(f"{name}: weights of another model: missing {missing[:4]}, left over {extra[:4]}")
    for key, tensor in tensors.items():
        kinds = (expected[key].dtype, torch.float16) if expected[key].dtype == torch.float32 else (expected[key].dtype,)
        if tensor.shape != expected[key].shape or tensor.dtype not in kinds:
            raise InputError(
                f"{name}: weights of another model: {key} has shape {list(tensor.shape)} of {tensor.dtype}, expected "
                f"{list(expected[key].shape)} of {expected[key].dtype}"
            )


def folder_of_weights(sha256: str, more: Iterable[Path] = ()) -> Path | None:
    """The model with these weights among the folders of `more` and the bundled ones; None when it is not there."""
    return next((path for path in (*more, *bundled_models().values()) if describe_model(path).sha256 == sha256), None)
