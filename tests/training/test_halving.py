"""Models passed on with float16 weights: half the size, the same pictures, and errors."""

from pathlib import Path

import pytest
import torch

from carstudio.cli import run
from carstudio.errors import InputError
from carstudio.geometry.orbit import orbit_camera
from carstudio.models.interface import render_image
from carstudio.tensors import load_tensors
from carstudio.training.checkpoint import describe_model, halve_model, load_model, load_weights_of, save_model
from models.test_car_gaussians import batch, small_model


@pytest.fixture
def trained(tmp_path: Path) -> Path:
    model = small_model()
    save_model(tmp_path / "run", model, model.config, {"step": 7})
    return tmp_path / "run"


@torch.no_grad()
def test_a_halved_model_shows_the_same_cars(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models", "halve", str(trained), "--out", str(tmp_path / "half")]) == 0
    assert "use it wherever the run would do" in capsys.readouterr().out
    whole, half = ((folder / "model.safetensors").stat().st_size for folder in (trained, tmp_path / "half"))
    assert half < 0.6 * whole
    assert {tensor.dtype for tensor in load_tensors(tmp_path / "half" / "model.safetensors").values()} == {
        torch.float16
    }
    models, patches = (load_model(trained), load_model(tmp_path / "half")), batch()
    assert {parameter.dtype for parameter in models[1].parameters()} == {torch.float32}
    for one, other in zip(models[0].parameters(), models[1].parameters(), strict=True):
        assert torch.allclose(one, other, rtol=2**-11, atol=1e-7)
    a, b = (render_image(model, orbit_camera(24), model.encode(patches), patches.box)["rgb"] for model in models)
    assert 0 < float((a - b).abs().max()) < 4e-3  # one step of an 8-bit picture
    described = describe_model(tmp_path / "half")
    assert described.config == describe_model(trained).config
    assert described.provenance["step"] == 7
    assert describe_model(trained).sha256 in described.provenance["weights"]
    load_weights_of(tmp_path / "half", small_model(), models[0].config)  # type: ignore[arg-type]


def test_what_cannot_be_halved(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="holds a model already"):
        halve_model(trained, trained)
    model = small_model()
    with torch.no_grad():
        model.shape_head.weight[0, 0] = 1e5
    save_model(tmp_path / "large", model, model.config, {})
    with pytest.raises(InputError, match=r"shape_head.weight holds numbers beyond float16's 65,504"):
        halve_model(tmp_path / "large", tmp_path / "half")
    assert not (tmp_path / "half").exists()
    assert run(["models", "halve", "a", "b"]) == 2
    assert "expected RUN --out FOLDER, found a b without --out" in capsys.readouterr().err
