"""`table ttopt`: what its files say agrees with its rows, and a second run measures nothing again."""

import json
import shutil
from pathlib import Path

import pytest

from carstudio.cli import run
from carstudio.comparison.budgets import BUDGETS
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
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


def test_tracks_are_scored_by_angle_and_drawn_above_their_truth(made: tuple[Path, list[str]], tmp_path: Path) -> None:
    """Fitted to drives past two cars, with the model trained in the other test's folder."""
    tracks = tmp_path / "tracks"
    synthesize(SynthConfig(out=tracks, cars=2, views=3, size=48, seed=8, tracks=True, workers=1))
    out, command = tmp_path / "out", made[1]
    shutil.copytree(made[0] / "runs", out / "runs")
    shutil.rmtree(out / "runs" / "nsg")  # it is trained on the very photos that the others are fitted to
    command = [*command, "--fit-data", str(tracks), "--fit-split", "yaw"]
    command[command.index("--out") + 1] = str(out)
    assert run(command) == 0
    rows = rows_of(out)
    held_out = {(str(row["instance_id"]), str(row["patch_id"])) for row in rows if row["views"] == "held-out"}
    assert len(held_out) == 2 * (BUDGETS["smoke"].fitting.scored_views or 0)
    assert all("turned" in patch for _, patch in held_out)
    assert all("turned" not in str(row["patch_id"]) for row in rows if row["views"] == "fitted")
    text = (out / "ttopt.md").read_text()
    assert "by the angle to the nearest fitted view" in text
    assert (
        "6 steps of some 128 rays of each car; scored: at most 2 held-out views and 2 fitted (43 rays of each" in text
    )
    strips = read_image(out / "strips.png")
    assert strips.shape[0] == 2 * (3 + 1) * 40 + 8, "two fits of Gaussians, NSG and the truth for each car, and a gap"
    left = strips.shape[1] - 80 * 20
    truth = strips[3 * 40 : 4 * 40, left + 80 :].astype(int)
    tiles = truth.reshape(40, 19, 80, 3).transpose(1, 0, 2, 3)
    drawn = (tiles < 250).any(axis=-1).reshape(19, -1).mean(axis=1)
    assert (drawn > 0.1).all(), "a true view for every turn"
    widths = (tiles < 250).any(axis=(1, 3)).sum(axis=1)
    sides = sorted(range(19), key=lambda turn: widths[turn])
    assert widths[sides[-1]] > 1.3 * widths[sides[0]], "ends of the car are narrower than its sides"
