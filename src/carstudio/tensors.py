"""Tensors in files: safetensors, written whole or not at all, and never unpickled."""

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from carstudio.errors import InputError
from carstudio.files import write_bytes


def save_tensors(path: Path, tensors: dict[str, torch.Tensor], metadata: dict[str, str] | None = None) -> None:
    """Write tensors as safetensors, atomically."""
    on_cpu = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    # Not safetensors' own `save_file`: it writes to a temporary name of its own, which a kill leaves behind.
    write_bytes(path, save(on_cpu, metadata=metadata))


def load_tensors(path: Path) -> dict[str, torch.Tensor]:
    """Read a safetensors file; `InputError` when it is missing, cut short or something else."""
    try:
        return load_file(path)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; expected the weights of a model") from error
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a whole safetensors file ({error}); train again or copy it again") from error
