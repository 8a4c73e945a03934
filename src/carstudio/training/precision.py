"""In which number format a training step multiplies matrices; weights, sums and everything else stay float32."""

import contextlib
from typing import Literal

import torch

Precision = Literal["auto", "float32", "bfloat16"]


def resolve_precision(precision: Precision, device: torch.device) -> Literal["float32", "bfloat16"]:
    """Turn "auto" into what the device does fastest: bfloat16 where it has matrix units for it, else float32.

    A CPU has them when it has AMX: there a step of `car-nerf-small` was 1.7 times as fast (docs/experiments.md).
    """
    if precision != "auto":
        return precision
    if device.type == "cuda":
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    return "bfloat16" if device.type == "cpu" and _cpu_has_amx() else "float32"


def _cpu_has_amx() -> bool:
    if not hasattr(torch.cpu, "get_capabilities"):  # an older torch does not tell: float32 is always right
        return False
    return bool(torch.cpu.get_capabilities().get("amx_bf16"))


def autocast(precision: Precision, device: torch.device) -> contextlib.AbstractContextManager[object]:
    """Context in which layers compute in the resolved precision."""
    if resolve_precision(precision, device) == "float32":
        return contextlib.nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)
