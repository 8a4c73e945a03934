"""Every example that needs no data of its own runs as a reader would run it."""

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_python_examples_run(path: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, path], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "loss: colour_fine" in done.stdout
    assert not any(tmp_path.iterdir())  # what it makes is temporary


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.sh")), ids=lambda path: path.name)
def test_shell_examples_parse_and_ask_for_their_arguments(path: Path, tmp_path: Path) -> None:
    assert subprocess.run(["sh", "-n", path], check=False).returncode == 0
    done = subprocess.run(["sh", path], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "usage:" in done.stderr
