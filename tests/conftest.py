"""What every test can ask for: the folder with real data, and the same random numbers on every run."""

import os
from pathlib import Path

import hypothesis
import numpy as np
import pytest
import torch

# Property tests draw the same examples every time, and slow machines are no failures: no timing is asserted anywhere.
hypothesis.settings.register_profile("carstudio", deadline=None, derandomize=True, database=None, max_examples=50)
hypothesis.settings.load_profile("carstudio")


@pytest.fixture(scope="session")
def repo_root() -> Path:
    """The folder with pyproject.toml."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def test_data(repo_root: Path) -> Path:
    """Folder of real inputs (KITTI, meshes, ONNX files): CARSTUDIO_TEST_DATA, else ../shared/data; else skip."""
    named = os.environ.get("CARSTUDIO_TEST_DATA")
    folder = Path(named).expanduser() if named else repo_root.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(
            f"no test data at {folder}: set CARSTUDIO_TEST_DATA to the folder that holds kitti-mot and kitti-obj"
        )
    return folder


@pytest.fixture(scope="session")
def dd3d_data(repo_root: Path) -> Path:
    """Folder with outputs of the original DD3D: CARSTUDIO_DD3D_DATA, else ../shared/dd3d; else skip."""
    named = os.environ.get("CARSTUDIO_DD3D_DATA")
    folder = Path(named).expanduser() if named else repo_root.parent / "shared" / "dd3d"
    if not folder.is_dir():
        pytest.skip(f"no reference of DD3D at {folder}: set CARSTUDIO_DD3D_DATA to the folder that holds recipe.py")
    return folder


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    """Seed the global generators that a test might use without asking for its own."""
    torch.manual_seed(0)
    np.random.seed(0)


def pytest_configure() -> None:
    """Give each xdist worker one thread: workers times intra-op threads would fight for the cores."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        torch.set_num_threads(1)
