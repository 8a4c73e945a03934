import pytest
import torch

from carstudio.training import precision
from carstudio.training.precision import autocast, resolve_precision

CPU = torch.device("cpu")


def test_auto_follows_the_matrix_units(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "_cpu_has_amx", lambda: True)
    assert resolve_precision("auto", CPU) == "bfloat16"
    monkeypatch.setattr(precision, "_cpu_has_amx", lambda: False)
    assert resolve_precision("auto", CPU) == "float32"
    assert resolve_precision("auto", torch.device("mps")) == "float32"
    assert resolve_precision("bfloat16", CPU) == "bfloat16"


def test_layers_compute_in_the_asked_format_and_keep_float32_weights() -> None:
    layer, x = torch.nn.Linear(64, 64), torch.randn(8, 64)
    with autocast("float32", CPU):
        exact = layer(x)
    with autocast("bfloat16", CPU):
        rough = layer(x)
    assert exact.dtype == torch.float32
    assert rough.dtype == torch.bfloat16
    # bfloat16 keeps 8 bits: each of 64 products of size ~1/8 is off by at most 2^-8 of itself, twice
    torch.testing.assert_close(rough.float(), exact, atol=0.03, rtol=0.03)
    rough.sum().backward()
    assert layer.weight.dtype == layer.weight.grad.dtype == torch.float32
