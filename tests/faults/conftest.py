"""One server of forks and one set of inputs per test process."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from faults.forks import Forks
from faults.server import Request
from faults.targets import TRAIN, make_inputs


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Runs the program in forks of a process that has imported everything."""
    with Forks() as server:
        yield server


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`cars`, a store to train on, and `kitti`, pictures to build from."""
    folder = tmp_path_factory.mktemp("inputs")
    make_inputs(folder)
    return folder


@pytest.fixture(scope="session")
def trained(forks: Forks, inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of `TRAIN`."""
    folder = tmp_path_factory.mktemp("trained")
    arguments = TRAIN.arguments(inputs, folder / "run")
    assert forks.run(Request(arguments=arguments, log=str(folder / "log"))).code == 0, (folder / "log").read_text()
    return folder / "run"
