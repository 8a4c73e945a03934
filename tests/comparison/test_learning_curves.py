"""`table ttopt`: what its files say agrees with its rows, and a second run measures nothing again."""

import json
from pathlib import Path

import pytest

from carstudio.cli import run
from carstudio.images import read_image
from training.toy import toy_store


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    folder = tmp_path_factory.mktemp("ttopt")
    store = toy_store(folder / "store", cars=2, views=3)
    command = ["table", "ttopt", "--data", str(store.path), "--out", str(folder / "out"), "--budget", "smoke"]
    command += ["--steps", "3", "--rows", "car-gaussians", "nsg", "--device", "cpu", "--quiet"]
    assert run(command) == 0
    return folder / "out", command


def rows_of(out: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]


def test_rows_say_how_each_view_was_scored(made: tuple[Path, list[str]]) -> None:
    rows = rows_of(made[0])
    assert {row["method"] for row in rows} == {
        "car-gaussians: latents",
        "car-gaussians: latents and field",
        "nsg: no prior",
    }
    fitted = [row for row in rows if row["method"] == "car-gaussians: latents"]
    assert {row["fit_steps"] for row in fitted} == {0, 2, 6}
    assert {(row["views"], row["split"], row["protocol"]) for row in rows} == {
        ("held-out", "view:test", "novel-view"),
        ("fitted", "view:train", "input-view"),
    }
    start = [
        [row["psnr"] for row in rows if row["method"] == method and row["fit_steps"] == 0]
        for method in ("car-gaussians: latents", "car-gaussians: latents and field")
    ]
    assert start[0] == start[1], "both begin at the encoder's result"


def test_tables_are_means_of_the_rows(made: tuple[Path, list[str]]) -> None:
    out, _ = made
    rows = [r for r in rows_of(out) if r["method"] == "car-gaussians: latents" and r["views"] == "held-out"]
    means = {
        steps: sum(float(str(r["psnr"])) for r in rows if r["fit_steps"] == steps) / (len(rows) / 3) for steps in (0, 6)
    }
    line = next(
        line for line in (out / "ttopt.md").read_text().splitlines() if line.startswith("| Car-Gaussians: latents |")
    )
    cells = [cell.split()[0] for cell in line.strip("| ").split(" | ")[3:5]]
    assert cells == [f"{means[0]:.2f}", f"{means[6]:.2f}"]
    names = read_image(out / "strips.png").shape[1] - 80 * 20
    assert 100 < names < 400, "a column of names, the photo and 19 turns"
    for name in ("ttopt.tex", "ttopt.html", "curve.png", "before_after.png"):
        assert (out / name).stat().st_size > 500, name


def test_a_second_run_measures_nothing_again(made: tuple[Path, list[str]], capsys: pytest.CaptureFixture[str]) -> None:
    out, command = made
    kept = [*out.glob("curves/*/curve.json"), *out.glob("runs/*/model.safetensors")]
    assert len(kept) == 5
    stamps = [path.stat().st_mtime_ns for path in kept]
    assert run(command) == 0
    assert [path.stat().st_mtime_ns for path in kept] == stamps
    assert run([*command, "--seed", "1"]) == 2
    assert "begun with other settings" in capsys.readouterr().err
