"""Several processes train one model: the same steps, shared out."""

import dataclasses
import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError, Interrupted
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.models.interface import CategoryModel
from carstudio.training.log import read_log
from carstudio.training.team import Team
from carstudio.training.trainer import train
from training.toy import TINY, toy_store

EXACT = dataclasses.replace(  # nothing in it is random within a share
    TINY, model=CarGaussiansConfig(encoder=TINY.model.encoder, num_splats=32, code_size=16, width=16, colour_skip_px=4)
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store")


def test_a_team_does_what_one_process_does(store: PatchStore, tmp_path: Path) -> None:
    """Six patches shared by three: after twelve steps the same weights, but for the order of sums."""
    train(EXACT, store, tmp_path / "1", device="cpu")
    train(EXACT, store, tmp_path / "3", device="cpu", processes=3)
    alone, shared = (load_file(tmp_path / name / "model.safetensors") for name in ("1", "3"))
    moved = 0.0
    for name, tensor in alone.items():
        torch.testing.assert_close(shared[name], tensor, rtol=1e-4, atol=1e-5, msg=name)
        moved = max(moved, float((shared[name] - tensor).abs().max()))
    assert moved > 0, "another order of sums must show somewhere, or nothing was shared"
    rows = [read_log(tmp_path / name / "log.jsonl") for name in ("1", "3")]
    for mine, theirs in zip(*rows, strict=True):
        assert mine | {"psnr": 0} == pytest.approx(theirs | {"psnr": 0}, rel=1e-4)
        assert mine["psnr"] == pytest.approx(theirs["psnr"], abs=1.0)  # a mean of the shares' decibels
    assert multiprocessing.active_children() == []


def test_gradients_are_weighted_by_the_rays_they_stand_on(store: PatchStore, tmp_path: Path) -> None:
    """Five patches for two processes: three and two, yet each ray counts the same."""
    odd = dataclasses.replace(EXACT, patches_per_step=5, steps=4)
    train(odd, store, tmp_path / "1", device="cpu")
    train(odd, store, tmp_path / "2", device="cpu", processes=2)
    alone, shared = (load_file(tmp_path / name / "model.safetensors") for name in ("1", "2"))
    for name, tensor in alone.items():
        torch.testing.assert_close(shared[name], tensor, rtol=1e-4, atol=1e-5, msg=name)


def test_a_team_that_is_stopped_goes_on_to_the_same_bits(store: PatchStore, tmp_path: Path) -> None:
    calls = iter(range(100))
    train(TINY, store, tmp_path / "whole", device="cpu", processes=2)
    with pytest.raises(Interrupted):
        train(TINY, store, tmp_path / "parts", device="cpu", processes=2, should_stop=lambda: next(calls) == 6)
    assert multiprocessing.active_children() == []
    train(TINY, store, tmp_path / "parts", device="cpu", processes=2, resume=True)
    for name in ("model.safetensors", "log.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


def test_a_process_that_dies_is_told(store: PatchStore, tmp_path: Path) -> None:
    def kill(model: CategoryModel, step: int) -> None:
        if step == 4:
            multiprocessing.active_children()[0].kill()

    with pytest.raises(InputError, match=r"ended from outside.*--resume"):
        train(TINY, store, tmp_path / "run", device="cpu", processes=2, on_save=kill)
    train(TINY, store, tmp_path / "run", device="cpu", resume=True)


def test_what_another_process_complains_of_is_heard(tmp_path: Path) -> None:
    """The store is gone by the time the second process opens it."""
    store = toy_store(tmp_path / "store")
    (tmp_path / "store").rename(tmp_path / "moved")
    with pytest.raises(InputError, match="store"):
        train(TINY, store, tmp_path / "run", device="cpu", processes=2)


def test_no_more_processes_than_patches(store: PatchStore, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected 1 to 6, found 7"):
        train(TINY, store, tmp_path, device="cpu", processes=7)


def test_a_team_shares_every_patch_once() -> None:
    taken = sorted(row for rank in range(3) for row in Team(rank, 3).share(8))
    assert taken == list(range(8))


SCRIPT = """
from pathlib import Path
import sys
from carstudio.dataset.store import open_store
from carstudio.training.trainer import train
from training.toy import TINY
summary = train(TINY, open_store(Path(sys.argv[1])), Path(sys.argv[2]), device="cpu")
print("done", summary.steps, summary.sha256)
"""


def test_torchrun_is_a_team_too(store: PatchStore, tmp_path: Path, repo_root: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": f"{repo_root / 'src'}:{repo_root / 'tests'}", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    found = subprocess.run(
        [*command, str(script), str(store.path), str(tmp_path / "run")],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert found.returncode == 0, found.stderr[-2000:]
    summary = train(TINY, store, tmp_path / "two", device="cpu", processes=2)
    assert found.stdout.count(summary.sha256) == 2, found.stdout  # both processes print, in each other's midst
    assert (tmp_path / "two" / "model.safetensors").read_bytes() == (
        tmp_path / "run" / "model.safetensors"
    ).read_bytes()
