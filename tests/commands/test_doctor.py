"""`carstudio doctor`: what is there and what is missing, for people and for programs."""

import json
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from carstudio.cli import run
from carstudio.commands import doctor
from carstudio.commands.doctor import EXTRAS, Package, free_disk, parse_requirements, problems
from carstudio.perception.weights import KNOWN_MODELS

LINES = [
    "torch>=2.6",
    "surely-not-there>=1",
    'nothing-of-the-kind>=1.17; extra == "onnx"',
    'pytest>=8; extra == "dev"',
    'carstudio[onnx]; extra == "dev"',
    'tomli>=2; python_version < "3.0"',
]


def test_programs_get_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert found["torch"]["version"] == metadata.version("torch")
    assert found["torch"]["devices"][0] == "cpu"
    assert found["problems"] == []
    versions = {package["name"]: package["version"] for package in found["packages"]}
    assert versions["numpy"] == metadata.version("numpy")
    assert {model["name"] for model in found["models"]} == {model.name for model in KNOWN_MODELS}
    assert all(disk["free_gb"] >= 0 for disk in found["disk"])


def test_people_get_what_to_do(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    missing = Package("onnxruntime", "onnx", ">=1.17", None, is_right=False)
    monkeypatch.setattr(doctor, "installed_packages", lambda: [missing])
    assert run(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert "onnxruntime missing" in shown
    assert f"for {EXTRAS['onnx']}: pip install 'carstudio[onnx]' or ./run setup onnx" in shown
    assert shown.rstrip().endswith("the core is whole")
    for model in KNOWN_MODELS:
        assert model.name in shown


def test_a_broken_core_is_an_error(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    old = Package("transformers", None, ">=5.0", "4.40", is_right=False)
    monkeypatch.setattr(doctor, "installed_packages", lambda: [old])
    assert run(["doctor"]) == 2
    told = capsys.readouterr().err
    assert "BROKEN: transformers>=5.0 is needed, 4.40 is installed: pip install 'transformers>=5.0'" in told


def test_requirements_are_read() -> None:
    packages = parse_requirements(LINES, ["onnx", "dev"])
    assert [(p.name, p.extra, p.wanted) for p in packages] == [
        ("torch", None, ">=2.6"),
        ("surely-not-there", None, ">=1"),
        ("nothing-of-the-kind", "onnx", ">=1.17"),
        ("pytest", "dev", ">=8"),
    ]
    assert [p.is_right for p in packages] == [True, False, False, True]
    too_old = parse_requirements(["torch>=99"], [])[0]
    assert too_old.version is not None
    assert not too_old.is_right


def test_only_the_core_is_a_problem() -> None:
    found = problems(parse_requirements(LINES, ["onnx", "dev"]), {})
    assert found == ["surely-not-there>=1 is needed, none is installed: pip install 'surely-not-there>=1'"]
    assert "torch does not work (OSError: no libgomp)" in problems([], {"error": "OSError: no libgomp"})[0]


def test_every_extra_has_a_purpose(repo_root: Path) -> None:
    project = tomllib.loads((repo_root / "pyproject.toml").read_text())["project"]
    assert set(project["optional-dependencies"]) == set(EXTRAS)


def test_disk_of_places_that_are_not_there_yet(tmp_path: Path) -> None:
    outputs = next(disk for disk in free_disk(tmp_path / "a" / "b") if disk["what"] == "outputs")
    assert outputs["folder"] == str(tmp_path / "a" / "b")
    assert outputs["free_gb"] > 0
