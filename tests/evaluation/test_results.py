"""Result files: round trip, refusal with the line named, means and their intervals."""

import json
from dataclasses import replace

import numpy as np
import pytest

from carstudio.errors import InputError
from carstudio.evaluation.results import (
    ResultHeader,
    ResultRow,
    header_path,
    read_header,
    read_rows,
    write_rows,
)
from carstudio.evaluation.summary import estimate, summarise

CONTRACT = (
    "method protocol split instance_id patch_id input_patch_id psnr psnr_mask ssim ssim_mask lpips mask_iou "
    "seed steps data_sha256 checkpoint_sha256"
)
ROW = ResultRow(
    method="car-nerf", protocol="novel-view", split="instance", instance_id="car 1", patch_id="b", input_patch_id="a",
    psnr=20.5, psnr_mask=17.25, ssim=0.75, ssim_mask=0.5, lpips=None, mask_iou=0.875, seed=3, steps=1000,
    data_sha256="d" * 64, checkpoint_sha256="c" * 64,
)  # fmt: skip


def test_fields_are_those_of_the_contract(tmp_path):
    write_rows(tmp_path / "rows.jsonl", [ROW])
    assert list(json.loads((tmp_path / "rows.jsonl").read_text())) == CONTRACT.split()


def test_rows_and_header_survive_a_round_trip(tmp_path):
    rows = [ROW, replace(ROW, patch_id='ä\u2028 "quoted"\n', psnr=None, lpips=1 / 3)]
    header = ResultHeader(command="carstudio evaluate", reasons={"lpips": "not installed"})
    write_rows(tmp_path / "rows.jsonl", rows, header)
    assert read_rows(tmp_path / "rows.jsonl") == rows
    assert read_header(tmp_path / "rows.jsonl") == header
    assert header_path(tmp_path / "rows.jsonl") == tmp_path / "rows.header.json"
    header_path(tmp_path / "rows.jsonl").unlink()
    assert read_header(tmp_path / "rows.jsonl") == ResultHeader()


def test_pandas_style_readers_see_plain_json_lines(tmp_path):
    import pyarrow.json

    write_rows(tmp_path / "rows.jsonl", [ROW, ROW])
    table = pyarrow.json.read_json(tmp_path / "rows.jsonl")
    assert table["psnr"].to_pylist() == [20.5, 20.5]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"psnr": "20"}, r"line 3: psnr must be a finite number or null, found '20'"),
        ({"psnr": float("nan")}, "line 3: psnr must be a finite number"),
        ({"psnr": True}, "line 3: psnr must be a finite number"),
        ({"seed": 1.5}, "line 3: seed must be a whole number"),
        ({"method": None}, "line 3: method must be a string"),
        ({"steps": ...}, "line 3: missing steps"),
    ],
)
def test_a_bad_row_is_refused_with_its_line(tmp_path, change, message):
    path = tmp_path / "rows.jsonl"
    write_rows(path, [ROW])
    value = json.loads(path.read_text()) | change
    value = {key: item for key, item in value.items() if item is not ...}
    path.write_text(path.read_text() + "\n" + json.dumps(value) + "\n")
    with pytest.raises(InputError, match=message):
        read_rows(path)


@pytest.mark.parametrize("line", ["{", "[1]", "nonsense"])
def test_a_line_that_is_no_object_is_refused(tmp_path, line):
    (tmp_path / "rows.jsonl").write_text(line + "\n")
    with pytest.raises(InputError, match=r"rows\.jsonl line 1: expected (a )?JSON"):
        read_rows(tmp_path / "rows.jsonl")


def test_a_missing_file_is_the_users_business(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_rows(tmp_path / "none.jsonl")


def test_not_a_number_is_never_written(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_rows(tmp_path / "rows.jsonl", [replace(ROW, psnr=float("inf"))])
    assert not (tmp_path / "rows.jsonl").exists()


def random_rows(seed=0, cars=12):
    generator = np.random.default_rng(seed)
    rows = []
    for car in range(cars):
        level = 20 + 2 * generator.standard_normal()
        for view in range(int(generator.integers(1, 6))):
            psnr = level + 0.1 * generator.standard_normal()
            rows.append(replace(ROW, instance_id=f"car {car}", patch_id=f"{car}-{view}", psnr=psnr))
    return rows


def test_the_mean_is_over_images_and_groups_do_not_mix():
    rows = random_rows()
    others = [replace(row, protocol="input-view", psnr=5.0) for row in rows]
    novel, given = summarise(rows + others)
    assert (novel.method, novel.protocol, novel.split) == ("car-nerf", "novel-view", "instance")
    assert novel.metrics["psnr"].mean == pytest.approx(np.mean([row.psnr for row in rows]))
    assert (novel.num_images, novel.num_instances) == (len(rows), 12)
    constant = given.metrics["psnr"]
    assert (constant.mean, constant.low, constant.high) == pytest.approx((5.0, 5.0, 5.0))
    assert "lpips" not in novel.metrics


def test_missing_scores_are_left_out_and_counted():
    rows = [ROW, replace(ROW, psnr=None, instance_id="car 2"), replace(ROW, psnr=10.5, instance_id="car 3")]
    psnr = summarise(rows)[0].metrics["psnr"]
    assert (psnr.mean, psnr.count) == (15.5, 2)


def test_row_order_changes_nothing_and_the_seed_is_the_only_chance():
    rows = random_rows()
    assert summarise(rows) == summarise(rows[::-1])
    assert summarise(rows, seed=1) == summarise(rows, seed=1)
    assert summarise(rows, seed=1) != summarise(rows, seed=2)


def test_interval_agrees_with_a_slow_bootstrap_over_cars():
    rows = random_rows()
    by_car = {}
    for row in rows:
        by_car.setdefault(row.instance_id, []).append(row.psnr)
    generator, cars, means = np.random.default_rng(5), list(by_car.values()), []
    for _ in range(4000):
        drawn = [cars[i] for i in generator.integers(len(cars), size=len(cars))]
        means.append(np.mean([value for car in drawn for value in car]))
    found = summarise(rows, draws=20000)[0].metrics["psnr"]
    # The ends of a bootstrap interval from 4000 draws scatter by about 0.05 standard errors.
    assert found.low == pytest.approx(np.quantile(means, 0.025), abs=0.15 * np.std(means))
    assert found.high == pytest.approx(np.quantile(means, 0.975), abs=0.15 * np.std(means))


def test_interval_matches_the_normal_one_for_many_single_image_cars():
    values = np.random.default_rng(0).normal(20, 3, 400)
    found = estimate(list(values), [str(i) for i in range(400)])
    half = 1.96 * values.std() / 20
    assert found.low == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert found.high == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_one_car_has_no_interval():
    assert estimate([1.0, 3.0], ["a", "a"]).low is None
