"""The state a run resumes from: weights, optimiser, step and time, in one safetensors file (one atomic write)."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor, nn

from carstudio.errors import InputError
from carstudio.training.checkpoint import load_tensors, load_weights, save_tensors

STATE = "training.safetensors"


@dataclass(frozen=True)
class TrainingState:
    """Tensors `model.NAME` and `optimizer.PARAMETER.SLOT`, finished steps, their seconds, what the run began with."""

    tensors: dict[str, Tensor]
    step: int
    seconds: float
    starts_from: str

    @classmethod
    def of(
        cls, model: nn.Module, optimizer: torch.optim.Optimizer, *, step: int, seconds: float, starts_from: str
    ) -> "TrainingState":
        """Collect the state of a run."""
        tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
        for name, parameter in model.named_parameters():
            for slot, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{name}.{slot}"] = value
        return cls(tensors, step, seconds, starts_from)

    def into(self, model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Put the state back."""
        weights = {name.removeprefix("model."): t for name, t in self.tensors.items() if name.startswith("model.")}
        load_weights(model, weights, name=STATE)
        for name, parameter in model.named_parameters():
            prefix = f"optimizer.{name}."
            for key, value in self.tensors.items():
                slot = key.removeprefix(prefix)
                if slot != key and "." not in slot:
                    on = "cpu" if slot == "step" else parameter.device
                    optimizer.state[parameter][slot] = value.to(on)


def save_state(folder: Path, state: TrainingState) -> None:
    """Write the state atomically."""
    metadata = {"step": json.dumps(state.step), "seconds": json.dumps(state.seconds), "starts_from": state.starts_from}
    save_tensors(folder / STATE, state.tensors, metadata)


def has_state(folder: Path) -> bool:
    """Whether a run can be resumed."""
    return (folder / STATE).exists()


def saved_step(folder: Path) -> int:
    """The step a run would go on from, read from the header alone."""
    with safe_open(folder / STATE, "pt") as file:
        return int((file.metadata() or {}).get("step", 0))


def load_state(folder: Path) -> TrainingState:
    """Read the state of a run; `InputError` when there is none or it is broken."""
    path = folder / STATE
    if not path.exists():
        raise InputError(f"{folder}: nothing to resume ({STATE} is missing); start without --resume")
    tensors = load_tensors(path)
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
    try:
        return TrainingState(
            tensors, int(metadata["step"]), float(metadata["seconds"]), metadata.get("starts_from", "")
        )
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: header lacks step or seconds ({error}); it is no training state") from error
