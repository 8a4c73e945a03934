"""The state a run resumes from: weights, optimiser, step and time, in one safetensors file (one atomic write)."""

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from carstudio.errors import InputError
from carstudio.tensors import load_tensors, save_tensors
from carstudio.training.checkpoint import load_weights

STATE = "training.safetensors"
SLOTS = ("step", "exp_avg", "exp_avg_sq")  # what all our optimisers keep of each parameter; step is one number
MAX_STEPS = 2**31


@dataclass(frozen=True)
class TrainingState:
    """Tensors `model.NAME` and `optimizer.PARAMETER.SLOT`, finished steps, their seconds by the clock and by the
    processors, what the run began with.
    """

    tensors: dict[str, Tensor]
    step: int
    seconds: float
    starts_from: str
    cpu_seconds: float = 0.0

    @classmethod
    def of(
        cls,
        model: nn.Module,
        optimizer: torch.optim.Optimizer,
        *,
        step: int,
        seconds: float,
        starts_from: str,
        cpu_seconds: float = 0.0,
    ) -> "TrainingState":
        """Collect the state of a run."""
        tensors = {f"model.{name}": tensor for name, tensor in model.state_dict().items()}
        for name, parameter in model.named_parameters():
            for slot, value in optimizer.state.get(parameter, {}).items():
                tensors[f"optimizer.{name}.{slot}"] = value
        return cls(tensors, step, seconds, starts_from, cpu_seconds)

    def into(self, model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
        """Put the state back."""
        weights = {name.removeprefix("model."): t for name, t in self.tensors.items() if name.startswith("model.")}
        load_weights(model, weights, name=STATE)
        parameters = dict(model.named_parameters())
        self._check_slots(parameters)
        for name, parameter in parameters.items():
            for slot in SLOTS:
                value = self.tensors.get(f"optimizer.{name}.{slot}")
                if value is not None:
                    on = "cpu" if slot == "step" and not optimizer.defaults.get("fused") else parameter.device
                    optimizer.state[parameter][slot] = value.to(on)

    def _check_slots(self, parameters: dict[str, nn.Parameter]) -> None:
        """Each parameter has all slots of the optimiser or none, of its shape, finite; and there are no others."""
        found = {key for key in self.tensors if key.startswith("optimizer.")}
        for name, parameter in parameters.items():
            slots = {f"optimizer.{name}.{slot}": (() if slot == "step" else parameter.shape) for slot in SLOTS}
            missing = sorted(slots.keys() - found)
            if missing and len(missing) < len(slots):
                raise InputError(f"{STATE}: lacks {missing}; it is damaged, start without --resume")
            for key, shape in slots.items():
                if key in found:
                    self._check_slot(key, tuple(shape))
            found -= slots.keys()
        if found:
            raise InputError(f"{STATE}: knows {sorted(found)[:3]}, the model does not; it belongs to another model")

    def _check_slot(self, key: str, shape: tuple[int, ...]) -> None:
        value = self.tensors[key]
        if tuple(value.shape) != shape or value.dtype != torch.float32:
            raise InputError(
                f"{STATE}: {key} has shape {list(value.shape)} of {value.dtype}, expected {list(shape)} of "
                "torch.float32; it belongs to another model"
            )
        if not bool(value.isfinite().all()) or (key.endswith(".step") and not 0 <= float(value) <= MAX_STEPS):
            raise InputError(f"{STATE}: {key} holds numbers that no optimiser has; start without --resume")


def save_state(folder: Path, state: TrainingState) -> None:
    """Write the state atomically."""
    metadata = {"step": json.dumps(state.step), "seconds": json.dumps(state.seconds), "starts_from": state.starts_from}
    metadata["cpu_seconds"] = json.dumps(state.cpu_seconds)
    metadata["sha256"] = checksum(state.tensors, metadata)
    save_tensors(folder / STATE, state.tensors, metadata)


def has_state(folder: Path) -> bool:
    """Whether a run can be resumed."""
    return (folder / STATE).exists()


def saved_step(folder: Path) -> int:
    """The step a run would go on from, read from the header alone."""
    try:
        with safe_open(folder / STATE, "pt") as file:
            return int((file.metadata() or {}).get("step", 0))
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{folder / STATE}: not a whole safetensors file ({error}); start without --resume") from error


def load_state(folder: Path) -> TrainingState:
    """Read the state of a run; `InputError` when there is none or it is broken."""
    path = folder / STATE
    if not path.exists():
        raise InputError(f"{folder}: nothing to resume ({STATE} is missing); start without --resume")
    tensors = load_tensors(path)
    with safe_open(path, "pt") as file:
        metadata = file.metadata() or {}
    told = metadata.pop("sha256", None)
    if told != checksum(tensors, metadata):
        raise InputError(
            f"{path}: sha256 is not the one written with it ({told}): the file was damaged or changed; copy it "
            "again, or train again in another folder"
        )
    try:
        step, seconds = int(metadata["step"]), float(metadata["seconds"])
        cpu_seconds = float(metadata.get("cpu_seconds", 0.0))  # older states do not tell
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: header lacks step or seconds ({error}); it is no training state") from error
    if not (0 <= step <= MAX_STEPS and 0 <= seconds < math.inf and 0 <= cpu_seconds < math.inf):
        raise InputError(
            f"{path}: step {step} and seconds {seconds}, {cpu_seconds} must be 0 or more; it is no training state"
        )
    return TrainingState(tensors, step, seconds, metadata.get("starts_from", ""), cpu_seconds)


def checksum(tensors: dict[str, Tensor], metadata: dict[str, str]) -> str:
    """Of names, types, shapes and bytes: a flipped bit in the optimiser's state would go unseen for ever."""
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
