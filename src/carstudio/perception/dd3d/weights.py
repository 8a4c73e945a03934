"""Public checkpoints of DD3D made ours: `model.safetensors` and `config.json` in a folder, and read back from there.

A public file is a pickle: it is read with `weights_only=True`, so that nothing in it is run. Keys and shapes are the
same on both sides, and every one is checked.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from carstudio.errors import InputError, first_line
from carstudio.files import make_folder, read_json, require_writable, sha256_file, write_json
from carstudio.perception.dd3d.model import DD3D, KITTI_CLASSES, Backbone, DD3DConfig
from carstudio.tensors import load_tensors, save_tensors

MODEL_TYPE, FORMAT_VERSION = "dd3d", 1
WEIGHTS, DESCRIPTION = "model.safetensors", "config.json"
_FIRST_KEY: dict[str, Backbone] = {  # which backbone a checkpoint has
    "backbone.bottom_up.base_layer.weight": "dla34",
    "backbone.bottom_up.stem.stem_1/conv.weight": "v2-99",
}
_CLASSES_KEY = "fcos2d_head.cls_logits.weight"
_COUNTER = "num_batches_tracked"  # of no use but for training; not every checkpoint has them
_SHOWN = 4


@dataclass(frozen=True)
class Converted:
    """What was made of a checkpoint."""

    folder: Path
    backbone: Backbone
    num_weights: int
    num_bytes: int


def convert(checkpoint: Path, out: Path) -> Converted:
    """Write a public checkpoint as a folder for `--box3d dd3d:FOLDER`; `InputError` when it is none that we know."""
    require_writable(out / WEIGHTS)
    tensors = read_checkpoint(checkpoint)
    backbone = backbone_of(tensors, name=str(checkpoint))
    expected = _expected(backbone)
    tensors = {key: torch.zeros(()).long() for key in expected if key.endswith(_COUNTER)} | tensors
    check_weights(expected, tensors, name=str(checkpoint))
    make_folder(out)
    save_tensors(out / WEIGHTS, {key: tensors[key].to(expected[key].dtype) for key in expected})
    description = {
        "model_type": MODEL_TYPE,
        "format_version": FORMAT_VERSION,
        "backbone": backbone,
        "classes": list(KITTI_CLASSES),
        "converted_from": {"file": checkpoint.name, "sha256": sha256_file(checkpoint)},
        "sha256": sha256_file(out / WEIGHTS),
    }
    write_json(out / DESCRIPTION, description)
    num_weights = sum(tensor.numel() for tensor in tensors.values())
    return Converted(out, backbone, num_weights, (out / WEIGHTS).stat().st_size)


def read_checkpoint(file: Path) -> dict[str, Tensor]:
    """The weights in a `.pth` file by their keys, wrappers of training removed; `InputError` when they are none."""
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{file}: no such file; expected a checkpoint of DD3D (.pth)") from error
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); expected a checkpoint of DD3D (.pth)") from error
    except Exception as error:  # UnpicklingError, RuntimeError, EOFError ...: whatever a broken or foreign file causes
        raise InputError(
            f"{file}: expected a checkpoint of tensors (.pth), found something else, which is not run "
            f"({type(error).__name__}: {first_line(error)}); download it again, or where you trust it save its weights "
            "alone: torch.save({'model': model.state_dict()}, FILE)"
        ) from error
    weights = content.get("model", content) if isinstance(content, Mapping) else None
    if not isinstance(weights, Mapping) or not weights:
        raise InputError(f"{file}: expected a dictionary of weights, or one below 'model', found {_kinds(content)}")
    if all(isinstance(key, str) and key.startswith("module.") for key in weights):
        weights = {key.removeprefix("module."): value for key, value in weights.items()}
    return {key: _tensor(key, value, name=str(file)) for key, value in weights.items()}


def _tensor(key: Any, value: Any, *, name: str) -> Tensor:
    if not isinstance(key, str) or not isinstance(value, Tensor):
        raise InputError(f"{name}: expected a tensor for every key, found {key!r:.60}: {type(value).__name__}")
    return value


def _kinds(content: Any) -> str:
    return f"keys {list(content)[:_SHOWN]}" if isinstance(content, Mapping) else type(content).__name__


def backbone_of(tensors: Mapping[str, Tensor], *, name: str) -> Backbone:
    """Which of the released networks has these weights; `InputError` when it is another."""
    for key, backbone in _FIRST_KEY.items():
        if key in tensors:
            classes = len(tensors[_CLASSES_KEY]) if _CLASSES_KEY in tensors else len(KITTI_CLASSES)
            if classes != len(KITTI_CLASSES):
                raise InputError(
                    f"{name}: expected a DD3D of KITTI's {len(KITTI_CLASSES)} classes ({', '.join(KITTI_CLASSES)}), "
                    f"found one of {classes} (nuScenes has 10); take the KITTI checkpoint"
                )
            return backbone
    raise InputError(
        f"{name}: expected a DD3D with DLA-34 or V2-99 (a key {' or '.join(_FIRST_KEY)}), found "
        f"{list(tensors)[:_SHOWN]}; take a KITTI checkpoint of the released models"
    )


def check_weights(expected: Mapping[str, Tensor], tensors: Mapping[str, Tensor], *, name: str) -> None:
    """`InputError` that names the weights that are missing, left over, of another shape, or not finite."""
    missing, extra = [k for k in expected if k not in tensors], [k for k in tensors if k not in expected]
    if missing or extra:
        raise InputError(
            f"{name}: not the weights of this DD3D: {_some('missing', missing)}, {_some('unexpected', extra)}; take "
            "the KITTI checkpoint of one of the released models, whole"
        )
    for key, tensor in tensors.items():
        if tensor.shape != expected[key].shape:
            raise InputError(
                f"{name}: {key} must have shape {list(expected[key].shape)}, has {list(tensor.shape)}; take the KITTI "
                "checkpoint of one of the released models"
            )
        if tensor.is_floating_point() != expected[key].is_floating_point() or not bool(tensor.isfinite().all()):
            raise InputError(f"{name}: {key} must hold finite numbers of {expected[key].dtype}; download it again")


def _some(what: str, keys: list[str]) -> str:
    return f"{what} {len(keys)}" + (
        f" ({', '.join(keys[:_SHOWN])}{' ...' if len(keys) > _SHOWN else ''})" if keys else ""
    )


def _expected(backbone: Backbone) -> dict[str, Tensor]:
    """Keys, shapes and kinds of numbers, without memory for them."""
    with torch.device("meta"):
        return DD3D(DD3DConfig(backbone)).state_dict()


def load_dd3d(folder: Path) -> DD3D:
    """The network that `convert` wrote, in evaluation mode on the CPU; `InputError` when the folder is not whole."""
    backbone, sha256 = _read_description(folder)
    tensors = load_tensors(folder / WEIGHTS)
    if sha256_file(folder / WEIGHTS) != sha256:
        raise InputError(f"{folder / WEIGHTS}: sha256 differs from the one in {DESCRIPTION}; convert it again")
    check_weights(_expected(backbone), tensors, name=str(folder / WEIGHTS))
    with torch.device("meta"):
        network = DD3D(DD3DConfig(backbone))
    network.load_state_dict(tensors, assign=True)
    network.canonical_sizes = torch.tensor(list(KITTI_CLASSES.values()))  # a constant, in no file
    return network.eval()


def _read_description(folder: Path) -> tuple[Backbone, str]:
    """Backbone and the weights' sha256."""
    path = folder / DESCRIPTION
    if not path.is_file():
        raise InputError(
            f"{folder}: no {DESCRIPTION}; expected a folder made by `carstudio models convert dd3d CHECKPOINT.pth "
            "--out FOLDER`"
        )
    value = read_json(path)
    if not isinstance(value, dict) or value.get("model_type") != MODEL_TYPE:
        raise InputError(f"{path}: expected model_type {MODEL_TYPE!r}; the folder holds another model")
    version, name, classes = (value.get(key) for key in ("format_version", "backbone", "classes"))
    backbone = next((known for known in get_args(Backbone) if known == name), None)
    if version != FORMAT_VERSION or backbone is None or classes != list(KITTI_CLASSES):
        raise InputError(
            f"{path}: expected format_version {FORMAT_VERSION}, backbone {' or '.join(get_args(Backbone))} and KITTI's "
            f"classes, found {version!r:.20}, {name!r:.40} and {classes!r:.80}; convert the checkpoint again"
        )
    return backbone, str(value.get("sha256"))
