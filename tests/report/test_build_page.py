"""The report of a build: what it shows is what the store says, whatever is missing in it."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from carstudio.cli import run
from carstudio.dataset.duplicates import find_duplicates
from carstudio.dataset.measured import measure
from carstudio.dataset.store import StoreWriter
from carstudio.errors import InputError
from carstudio.images import encode_png, read_image
from carstudio.report.build_page import BuildPageConfig, write_build_report
from carstudio.report.build_tables import camera_sentence, camera_table, dataset_tables, reason_table
from carstudio.report.colours import CYAN, ORANGE, PINK
from carstudio.report.distributions import ROSE_BINS, Distribution, bin_edges, histograms, rose_counts, viewpoint_rose
from carstudio.report.patch_sheets import caption, overlay, spread
from dataset.made_up_patches import made_up_record, made_up_store

NO_BOX = {"box_center": None, "box_size": None, "box_yaw": None, "box_iou": None}


def test_the_page_tells_reasons_thresholds_and_problems(tmp_path: Path) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(30)))
    out = tmp_path / "r"
    page = write_build_report(store.path, out, problems=["frame 7 skipped: <broken>"])
    text = page.read_text(encoding="utf-8")
    reasons = store.info()["reasons"]
    assert len(reasons) > 1
    for reason, count in reasons.items():
        assert reason in text
        assert f">{count}<" in text
        assert (out / "pictures" / f"sheet-{reason}.png").is_file()
    assert "at least 40" in text
    assert "frame 7 skipped: &lt;broken&gt;" in text
    assert "0° looks at the front" in text
    first = {path.name: path.read_bytes() for path in (out / "pictures").iterdir()}
    write_build_report(store.path, out)
    assert first == {path.name: path.read_bytes() for path in (out / "pictures").iterdir()}


def test_no_boxes_no_masks_no_patches(tmp_path: Path) -> None:
    bare = [made_up_record(i, mask=None, mask_ratio=None, **NO_BOX) for i in range(3)]
    text = write_build_report(made_up_store(tmp_path / "s", bare).path, tmp_path / "r").read_text(encoding="utf-8")
    assert "No patch has a 3-D box" in text
    with StoreWriter(tmp_path / "e", source="made-up"):
        pass
    assert "0 candidates" in write_build_report(tmp_path / "e", tmp_path / "re").read_text(encoding="utf-8")


def test_a_damaged_picture_is_shown_as_a_finding(tmp_path: Path) -> None:
    records = [made_up_record(0), made_up_record(1, image=b"\x89PNG none")]
    assert write_build_report(made_up_store(tmp_path / "s", records).path, tmp_path / "r").is_file()


def test_duplicates_are_counted_and_shown(tmp_path: Path) -> None:
    records = [made_up_record(i) for i in range(4)]
    records.append(made_up_record(0, patch_id="again"))
    store = made_up_store(tmp_path / "s", records)
    assert "Nobody has looked" in write_build_report(store.path, tmp_path / "r").read_text(encoding="utf-8")
    find_duplicates(store)
    text = write_build_report(store.path, tmp_path / "r").read_text(encoding="utf-8")
    assert "1 groups of like pictures: 2 patches are the same as another byte for byte, 0 nearly" in text
    assert read_image(tmp_path / "r" / "pictures" / "duplicates.png").shape[1] == 8 + 2 * (208 + 8)


def test_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(8)))
    assert run(["dataset", "report", str(store.path), "--out", str(tmp_path / "r"), "--per-reason", "2"]) == 0
    assert "index.html" in capsys.readouterr().out
    assert run(["dataset", "report", str(store.path), "--out", str(tmp_path / "r"), "--per-reason", "0"]) == 2
    assert "--per-reason must be 1 to" in capsys.readouterr().err


@given(st.integers(0, 500), st.integers(1, 40))
def test_spread_takes_distinct_indices_from_end_to_end(count: int, most: int) -> None:
    chosen = spread(count, most)
    assert len(chosen) == min(count, most)
    assert chosen == sorted(set(chosen))
    if chosen:
        assert chosen[0] == 0
        assert chosen[-1] == count - 1 or most == 1
        assert max(np.diff(chosen), default=0) <= -(-count // max(1, most - 1)) + 1


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60), st.lists(st.floats(-1e3, 1e3), max_size=2), st.booleans()
)
def test_bins_are_equal_and_hold_the_thresholds(values: list[float], thresholds: list[float], is_whole: bool) -> None:
    array = np.array(values)
    edges = bin_edges(np.round(array) if is_whole else array, thresholds)
    assert np.all(np.diff(edges) > 0)
    np.testing.assert_allclose(np.diff(edges), edges[1] - edges[0], rtol=1e-6, atol=1e-9)
    if thresholds:
        assert np.abs(edges - thresholds[0]).min() < 1e-6
        assert edges[0] < min(thresholds)
        assert max(thresholds) < edges[-1]


def test_rose_petals_by_hand() -> None:
    counts = rose_counts(np.array([0.0, -4.9, 4.9, 5.1, 90.0, 180.0, -180.0, -90.0, np.nan]))
    assert {int(i) * 360 // ROSE_BINS: int(counts[i]) for i in np.flatnonzero(counts)} == {
        0: 3, 10: 1, 90: 1, 180: 2, 270: 1,
    }  # fmt: skip


def test_the_rose_has_the_front_above_and_the_cars_left_on_the_left() -> None:
    """All cameras at azimuth 90: teal only left of the kept rose's middle."""
    picture = np.array(Image.open(BytesIO(viewpoint_rose(np.full(5, 90.0), np.ones(5, bool)))).convert("RGBA")).astype(
        int
    )
    teal = (np.abs(picture[..., :3] - (20, 163, 139)).sum(-1) < 30) & (picture[..., 3] > 200)
    rows, columns = np.nonzero(teal)
    height, width = teal.shape
    assert len(rows) > 500
    assert columns.max() <= width / 4 + 5
    assert abs(rows.mean() / height - 0.5) < 0.1
    front = np.array(Image.open(BytesIO(viewpoint_rose(np.zeros(5), np.ones(5, bool)))).convert("RGBA")).astype(int)
    rows, _ = np.nonzero((np.abs(front[..., :3] - (20, 163, 139)).sum(-1) < 30) & (front[..., 3] > 200))
    assert rows.max() <= height / 2 + 20


def test_a_threshold_is_drawn() -> None:
    distribution = Distribution(
        title="x", values=np.linspace(0, 1, 50), is_kept=np.linspace(0, 1, 50) > 0.5, thresholds=(0.5,), limit_text="t"
    )
    picture = np.array(Image.open(BytesIO(histograms([distribution]))).convert("RGB")).astype(int)
    pink = np.abs(picture - PINK).sum(-1) < 60
    assert pink.sum(axis=0).max() > 100  # a line from top to bottom


def test_overlays_draw_what_is_there(tmp_path: Path) -> None:
    def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
        return bool((np.abs(picture.astype(int) - colour).sum(-1) < 40).sum() > 50)

    record = made_up_record(4)
    black = encode_png(np.zeros((record.crop_height, record.crop_width, 3), np.uint8))
    whole = overlay(made_up_record(4, image=black))
    assert [has(whole, colour) for colour in (PINK, CYAN, ORANGE)] == [True, True, True]
    bare = overlay(made_up_record(4, image=black, mask=None, **NO_BOX))
    assert [has(bare, colour) for colour in (PINK, CYAN, ORANGE)] == [True, False, False]


def test_captions_tell_value_limit_and_what_is_missing(tmp_path: Path) -> None:
    records = [made_up_record(0), made_up_record(1), made_up_record(2, mask=None, **NO_BOX)]
    measured = measure(made_up_store(tmp_path / "s", records))
    ratio = records[0].mask_ratio
    assert caption(records[0], measured, 0) == f"p-00000\nmask_ratio {ratio:.3g}, limit 0.6"
    assert caption(records[1], measured, 1).startswith("p-00001\nIoU 1.00, mask 0.7")
    assert caption(records[2], measured, 2) == "p-00002\nbox3d 0, limit 1\nno mask, no 3-D box"


def test_tables_by_hand(tmp_path: Path) -> None:
    """Two sources: three views of one car from the side with a rough camera, one calibrated car from the front."""
    side = {"box_center": (0.0, 0.6, 12.0), "box_yaw": 0.0, "mask_ratio": 0.9}
    front = {"box_center": (0.0, 0.6, 12.0), "box_yaw": np.pi / 2, "mask_ratio": 0.9}
    records = [made_up_record(i, source="photos", camera_source="exif:28mm", box_iou=0.8, **side) for i in range(3)]
    records.append(made_up_record(6, **front))
    records.append(made_up_record(7, source="photos", camera_source="exif:28mm", **front | {"box_iou": 0.2}))
    measured = measure(made_up_store(tmp_path / "s", records))
    table, sizes = dataset_tables(measured)
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["made-up", "known", "0 % side", "1", "0", "1", "1"],
        ["photos", "rough", "100 % side", "0", "1", "3", "1"],
        ["all", "rough", "75 % side", "1", "1", "4", "2"],
    ]
    assert [row[1].text for row in sizes.rows] == ["1", "4", "5"]
    assert [cell.text for cell in reason_table(measured).rows[1]] == ["box_iou", "1", "20.0 %", "at least 0.7"]
    assert [[cell.text for cell in row] for row in camera_table(measured).rows][1] == [
        "exif:28mm", "4", "3", "0.800", "0.290", "yes",
    ]  # fmt: skip
    sentence = camera_sentence(measured)
    assert "The camera of 4 of 5 patches is rough" in sentence
    assert "median is 0.800, and 25 % miss" in sentence


def test_pictures_per_reason_have_a_bound() -> None:
    with pytest.raises(InputError, match="per-reason"):
        BuildPageConfig(per_reason=0)


def test_a_sheet_is_as_large_as_its_tiles(tmp_path: Path) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(30)))
    write_build_report(store.path, tmp_path / "r", config=BuildPageConfig(per_reason=4))
    assert read_image(tmp_path / "r" / "pictures" / "sheet-kept.png").shape[1] == 8 + 4 * (208 + 8)
