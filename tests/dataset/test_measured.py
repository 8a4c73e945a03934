"""The columns of numbers against the records and verdicts themselves, one at a time."""

import math
from pathlib import Path

import numpy as np
import pytest

from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.measured import UNJUDGED, measure, reasons_in_order
from carstudio.dataset.store import StoreWriter, open_store
from dataset.made_up_patches import made_up_record, made_up_store


def test_columns_are_the_records_values(tmp_path: Path) -> None:
    tilted = (math.cos(0.2), math.sin(0.2), 0.0, 0.0)
    changes = {3: {"box_center": None, "box_size": None, "box_yaw": None, "box_iou": None}, 4: {"mask": None}}
    changes[5] = {"box_rotation": tilted, "score_2d": 0.5}
    records = [made_up_record(i, **changes.get(i, {})) for i in range(20)]
    store = made_up_store(tmp_path / "s", records)
    measured = measure(store)
    assert measured.patch_id.tolist() == [record.patch_id for record in records]
    assert measured.has_mask.tolist() == [record.mask is not None for record in records]
    assert measured.has_box.tolist() == [record.box is not None for record in records]
    for i, (record, verdict) in enumerate(zip(records, store.verdicts(), strict=True)):
        assert (measured.reason[i], measured.is_kept[i]) == (verdict.reason, verdict.is_kept)
        assert measured.values["height_px"][i] == record.box2d[3] - record.box2d[1]
        for name in ("box_iou", "score_2d", "mask_ratio"):
            value = getattr(record, name)
            assert np.isnan(measured.values[name][i]) if value is None else measured.values[name][i] == value
        if record.box is None:
            assert np.isnan(measured.values["azimuth_deg"][i])
            continue
        toward = -(record.box.rotation.T @ record.box.center).numpy()  # the camera in the car frame, float32
        assert measured.values["azimuth_deg"][i] == pytest.approx(
            np.degrees(np.arctan2(toward[2], toward[0])), abs=1e-3
        )


def test_thresholds_come_from_the_verdicts_with_their_sense(tmp_path: Path) -> None:
    recipe = FilterRecipe(height_px=60.0, depth_m=20.0)
    measured = measure(made_up_store(tmp_path / "s", map(made_up_record, range(30)), recipe=recipe))
    assert (measured.thresholds["height_px"].text, measured.thresholds["depth_m"].text) == ("at least 60", "at most 20")
    assert measured.thresholds["width_px"].text == "32"  # rejected nothing: nobody knows its sense
    assert "type" not in measured.thresholds
    names = [name for name, _ in reasons_in_order(measured)]
    assert names[0] == "kept"
    assert sum(count for _, count in reasons_in_order(measured)) == 30


def test_a_store_without_verdicts_and_an_empty_one(tmp_path: Path) -> None:
    with StoreWriter(tmp_path / "s", source="made-up") as writer:
        writer.append(made_up_record(0))
    measured = measure(open_store(tmp_path / "s"))
    assert (measured.reason.tolist(), measured.is_kept.tolist()) == ([UNJUDGED], [True])
    with StoreWriter(tmp_path / "e", source="made-up"):
        pass
    assert len(measure(open_store(tmp_path / "e"))) == 0
