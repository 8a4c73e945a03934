"""The command line as a user meets it: whole runs on a toy store, exit codes, messages."""

import errno
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

import carstudio
import carstudio.training.trainer
from carstudio.cli import VERBS, run
from carstudio.errors import Interrupted, StorageError
from carstudio.images import read_image
from training.toy import toy_store

TRAIN = ["--quiet", "--steps", "2", "--split", "None", "--device", "cpu", "--pictures", "2"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a store `data` and a trained run `run`."""
    folder = tmp_path_factory.mktemp("cli")
    toy_store(folder / "data", cars=3, views=3)
    assert run(["train", "car-nerf-small", "--data", str(folder / "data"), "--out", str(folder / "run"), *TRAIN]) == 0
    return folder


def test_help_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert run([]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {verb}" in shown for verb in VERBS)


ACTIONS = ("info", "verify", "refilter", "merge", "split", "duplicates", "export", "card", "report")


@pytest.mark.parametrize(
    "words",
    [[verb] for verb in VERBS if verb not in ("dataset", "scene")]
    + [["dataset", action] for action in ACTIONS]
    + [["scene", action] for action in ("from-kitti-mot", "from-kitti-det", "info", "recolour")],
)
def test_every_verb_explains_itself(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run([*words, "--help"])
    assert stop.value.code == 0
    assert "--json" in capsys.readouterr().out


def test_an_unknown_verb_is_the_users_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["trian"]) == 2
    assert "no verb 'trian'" in capsys.readouterr().err


def test_training_leaves_model_log_and_picture(trained: Path) -> None:
    names = {path.name for path in (trained / "run").iterdir()}
    assert {"model.safetensors", "model.json", "log.jsonl", "training.safetensors", "pictures"} <= names
    picture = read_image(next((trained / "run" / "pictures").iterdir()))
    assert picture.shape[1] > 5 * 100


def test_evaluate_writes_rows_and_prints_json(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = trained / "rows.jsonl"
    command = ["evaluate", str(trained / "run"), "--data", str(trained / "data"), "--protocol", "novel-view"]
    assert run([*command, "--split", "none", "--out", str(rows), "--json", "--device", "cpu"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["rows"] == len(rows.read_text().splitlines()) == 9
    assert json.loads(rows.read_text().splitlines()[0])["method"] == "car-nerf-small"
    assert "lpips" in json.loads((trained / "rows.header.json").read_text())["reasons"]


def test_report_scores_both_protocols_on_one_page(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = trained / "report"
    command = ["report", str(trained / "run"), "--data", str(trained / "data"), "--out", str(out), "--split", "None"]
    assert run([*command, "--turntables", "1", "--device", "cpu", "--json"]) == 0
    protocols = {found["protocol"]: found["num_images"] for found in json.loads(capsys.readouterr().out)["summary"]}
    assert protocols == {"novel-view": 9, "input-view": 9}
    assert len((out / "novel-view.jsonl").read_text().splitlines()) == 9
    page = (out / "index.html").read_text()
    assert "From photo to car" in page
    assert read_image(out / "checks.png").shape[0] > 9 * 100  # nine rows of pictures
    assert len(list((out / "turntables").iterdir())) == 1


def test_report_of_cars_seen_once_has_no_novel_views(trained: Path) -> None:
    toy_store(trained / "once", cars=2, views=1)
    out = trained / "report-once"
    command = ["report", str(trained / "run"), "--data", str(trained / "once"), "--out", str(out), "--split", "None"]
    assert run([*command, "--turntables", "1", "--device", "cpu", "--quiet"]) == 0
    assert not (out / "novel-view.jsonl").exists()
    assert "Novel views" not in (out / "index.html").read_text()


def test_render_goes_round_the_car(trained: Path) -> None:
    out = trained / "views"
    command = ["render", str(trained / "run"), "--data", str(trained / "data"), "--patches", "toy-0-0"]
    assert run([*command, "--out", str(out), "--views", "3", "--size", "24", "--device", "cpu"]) == 0
    for kind in ("rgb", "opacity", "depth"):
        assert [path.name for path in sorted((out / "toy-0-0" / kind).iterdir())] == ["000.png", "001.png", "002.png"]
    assert (out / "toy-0-0" / "turntable.gif").read_bytes()[:4] == b"GIF8"
    assert b"ftyp" in (out / "toy-0-0" / "turntable.mp4").read_bytes()[:12]


def test_a_preview_is_nearly_the_picture(tmp_path: Path) -> None:
    car = "suv-red"  # a bundled one, by its name
    for name, more in (("full", []), ("preview", ["--preview"])):
        command = ["render", car, "--out", str(tmp_path / name), "--views", "2", "--size", "96", "--device", "cpu"]
        assert run([*command, *more]) == 0
    for kind in ("rgb", "opacity", "depth"):
        pair = [read_image(tmp_path / name / kind / "001.png").astype(float) for name in ("full", "preview")]
        assert pair[0].shape == pair[1].shape
        assert 0 < abs(pair[0] - pair[1]).mean() < 2.5, kind


def test_a_bundled_car_is_exported_by_its_name(tmp_path: Path) -> None:
    assert run(["export", "suv-red", "--format", "ply", "--out", str(tmp_path / "car.ply"), "--quiet"]) == 0
    assert (tmp_path / "car.ply").read_bytes().startswith(b"ply")


def test_the_package_runs_as_a_module() -> None:
    """As torchrun starts it."""
    found = subprocess.run([sys.executable, "-m", "carstudio", "--help"], capture_output=True, text=True, check=True)
    assert all(verb in found.stdout for verb in VERBS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "no-such", "--data", "DATA", "--out", "OUT"], "recipe must be one of"),
        (["train", "car-nerf-small", "--data", "NOWHERE", "--out", "OUT"], "NOWHERE"),
        (["train", "car-nerf-small", "--data", "DATA", "--out", "RUN", "--split", "None"], "--resume"),
        (["train", "car-nerf-small", "--data", "DATA", "--out", "OUT", "--device", "abacus"], "abacus"),
        (["evaluate", "DATA", "--data", "DATA", "--protocol", "input-view", "--out", "R"], "expected a trained model"),
        (
            ["evaluate", "RUN", "--data", "DATA", "--protocol", "input-view", "--out", "R", "--split", "instance"],
            "NAME:test",
        ),
        (["render", "RUN", "--data", "DATA", "--out", "OUT", "--patches", "toy-9-9"], "toy-9-9"),
        (["render", "RUN", "--data", "DATA", "--out", "OUT", "--size", "0"], "--size"),
        (["render", "RUN", "--data", "DATA", "--out", "OUT", "--patches", "toy-0-0", "--preview"], "--preview"),
        (["dataset", "info", "NOWHERE"], "NOWHERE"),
        (["build", "kitti-mot", "--root", "NOWHERE", "--out", "OUT"], "NOWHERE"),
    ],
)
def test_the_users_errors_are_one_message_and_exit_code_2(
    arguments: list[str], message: str, trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"DATA": trained / "data", "RUN": trained / "run", "OUT": trained / "new", "R": trained / "r.jsonl"}
    places["NOWHERE"] = trained / "NOWHERE"
    assert run([str(places.get(argument, argument)) for argument in arguments]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.startswith("error: ")
    assert "Traceback" not in shown


def ends_with(error: BaseException, monkeypatch: pytest.MonkeyPatch, trained: Path) -> int:
    """Exit code of a verb whose work raises `error`."""

    def fail(path: Path) -> None:
        raise error

    monkeypatch.setattr("carstudio.commands.dataset.open_store", fail)
    return run(["dataset", "info", str(trained / "data")])


def test_our_own_faults_keep_their_traceback_and_ask_for_a_report(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert ends_with(KeyError("colour"), monkeypatch, trained) == 1
    shown = capsys.readouterr().err
    assert "in fail" in shown
    assert "KeyError: 'colour'" in shown
    assert "a fault of carstudio" in shown
    assert f"carstudio dataset info {trained / 'data'}" in shown


def test_numbers_that_ran_away_are_told_without_a_traceback(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("carstudio.training.trainer.masked_psnr", lambda *arguments: 1.0)
    real = carstudio.training.trainer.training_loss

    def poisoned(*arguments: Any) -> dict[str, torch.Tensor]:
        return {name: term * math.nan for name, term in real(*arguments).items()}

    monkeypatch.setattr("carstudio.training.trainer.training_loss", poisoned)
    command = ["train", "car-nerf-small", "--data", str(trained / "data"), "--out", str(trained / "nan"), *TRAIN]
    assert run(command) == 1
    shown = capsys.readouterr().err
    assert shown.startswith("error: step 0: loss term ")
    assert "is nan for cars ['toy-" in shown
    assert "--resume with a lower --learning-rate, or with another --seed" in shown
    assert "Traceback" not in shown


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.EIO, "Input/output error", "/mnt/disk/manifest.json"), "'/mnt/disk/manifest.json'"),
        (StorageError("rows.jsonl", "No space left on device"), "rows.jsonl: cannot be written (No space left"),
    ],
)
def test_what_the_system_refuses_is_one_message(
    error: Exception,
    message: str,
    trained: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert ends_with(error, monkeypatch, trained) == 2
    first, saved, again = capsys.readouterr().err.splitlines()
    assert message in first
    assert saved == "nothing was written"
    assert again == f"go on with: carstudio dataset info {trained / 'data'}"


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (Interrupted(15), 143)])
def test_an_interruption_has_its_own_exit_code(
    error: BaseException,
    code: int,
    trained: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert ends_with(error, monkeypatch, trained) == code
    assert capsys.readouterr().err.startswith("interrupted; nothing was written\ngo on with: carstudio dataset info ")


def test_a_reader_that_leaves_is_no_error(trained: Path) -> None:
    program = "from carstudio.cli import main; main()"
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(
        [sys.executable, "-c", program, "dataset", "info", str(trained / "data")],
        stdout=writer,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_dataset_info_and_verify(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["dataset", "info", str(trained / "data"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["patches"] == 9


def test_the_learning_rate_keeps_its_fall_to_a_share_of_the_first(trained: Path) -> None:
    out = trained / "gentle"
    command = ["train", "car-nerf-small", "--data", str(trained / "data"), "--out", str(out), *TRAIN]
    assert run([*command, "--learning-rate", "1e-4", "--init", str(trained / "run")]) == 0
    schedule = json.loads((out / "model.json").read_text())["provenance"]["training"]["schedule"]
    assert schedule["first"] == 1e-4
    assert schedule["last"] == pytest.approx(1e-4 / 50)  # the recipe falls from 5e-3 to 1e-4
