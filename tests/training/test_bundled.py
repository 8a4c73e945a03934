"""Bundled models: there, of their size, made of synthetic data only, and good on cars that nobody trained on."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

import carstudio
from carstudio.cli import run
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.evaluation.protocols import EvaluationConfig, score_views, view_pairs
from carstudio.training.bundled import bundled_models, find_model
from carstudio.training.checkpoint import describe_model, load_model

MAX_BYTES = 20_000_000
NAMES = ("car-gaussians", "car-nerf-small")


def test_what_is_bundled() -> None:
    assert tuple(bundled_models()) == NAMES
    for name, folder in bundled_models().items():
        assert (folder / "model.safetensors").stat().st_size < MAX_BYTES
        card = (folder / "README.md").read_text(encoding="utf-8")
        assert card.startswith("---\n")
        assert "license: apache-2.0" in card
        assert describe_model(name).provenance["recipe"] == name
        command = json.loads((folder / "model.json").read_text())["provenance"]["command"]
        assert command in card


def test_a_folder_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_model("car-gaussians") == bundled_models()["car-gaussians"]
    Path("car-gaussians").mkdir()
    assert find_model("car-gaussians") == Path("car-gaussians")
    with pytest.raises(
        InputError, match=r"expected a trained model .* or take a bundled one: car-gaussians, car-nerf-small"
    ):
        load_model("car-gaussians")


@pytest.mark.parametrize(
    ("name", "least_psnr", "least_iou"), [("car-gaussians", 18.0, 0.95), ("car-nerf-small", 17.0, 0.94)]
)
def test_bundled_models_show_cars_they_never_saw(
    tmp_path: Path, name: str, least_psnr: float, least_iou: float
) -> None:
    """Six cars of another seed, novel views; grey pictures of the right outline would have about 13 dB."""
    synthesize(SynthConfig(out=tmp_path / "s", cars=6, views=3, size=96, seed=987, workers=1))
    model = carstudio.load_model(name)
    assert not model.training
    store = open_store(tmp_path / "s")
    pairs = view_pairs(store, EvaluationConfig(protocol="novel-view", split=None, part="all"))
    with torch.no_grad():
        scores = [view.scores for view in score_views(model, store, pairs)]
    assert len(scores) >= 12
    assert np.mean([score.psnr for score in scores]) > least_psnr
    assert np.mean([score.mask_iou for score in scores]) > least_iou


def test_a_bundled_model_has_its_report(tmp_path: Path) -> None:
    """By its name, and without a learning curve: its log is not in the package."""
    synthesize(SynthConfig(out=tmp_path / "s", cars=2, views=2, size=48, seed=3, workers=1))
    store = open_store(tmp_path / "s")
    command = ["report", "car-gaussians", "--data", str(store.path), "--out", str(tmp_path / "out"), "--split", "none"]
    assert run([*command, "--limit", "2", "--turntables", "0", "--device", "cpu", "--json"]) == 0
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "Learning curve" not in page
    assert "carstudio train car-gaussians" in page
