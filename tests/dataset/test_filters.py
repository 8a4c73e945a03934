"""Filters: each at its threshold, unknown values, and the order of reasons."""

import json
import math
from dataclasses import replace

import pytest

from carstudio.dataset.filters import DVM_CARS, FILTERS, FilterRecipe, judge
from carstudio.dataset.patch import PatchRecord

RECIPE = FilterRecipe()


@pytest.fixture
def record() -> PatchRecord:
    return PatchRecord(
        patch_id="p",
        instance_id="c",
        frame_id="f",
        source="kitti-det",
        image=b"",
        frame_path="f.png",
        frame_width=1242,
        frame_height=375,
        crop_x0=0,
        crop_y0=0,
        crop_width=101,
        crop_height=81,
        fx=700.0,
        fy=700.0,
        cx=600.0,
        cy=180.0,
        camera_source="calib:P2",
        box2d=(0.0, 0.0, 100.0, 80.0),
        box_center=(0.0, 1.0, 20.0),
        box_size=(4.0, 1.5, 1.8),
        box_yaw=0.0,
        score_mask=0.9,
        mask_ratio=0.8,
        box_iou=0.95,
        licence="CC0-1.0",
        sha256="",
        extra='{"type": "Car"}',
    )


EDGE = {  # filter -> the last change that passes and the first that fails
    "type": ({"extra": "{}"}, {"extra": '{"type": "Van"}'}),
    "height_px": ({"box2d": (0.0, 1.0, 100.0, 65.0)}, {"box2d": (0.0, 1.0, 100.0, 64.9)}),
    "width_px": ({"box2d": (1.0, 0.0, 33.0, 80.0)}, {"box2d": (1.0, 0.0, 32.9, 80.0)}),
    "depth_m": ({"box_center": (0.0, 1.0, 50.0)}, {"box_center": (0.0, 1.0, 50.1)}),
    "box_iou": ({"box_iou": 0.7}, {"box_iou": 0.69}),
    "score_mask": ({"score_mask": 0.61}, {"score_mask": 0.6}),
    "mask_ratio": ({"mask_ratio": 0.61}, {"mask_ratio": 0.6}),
    "box3d": ({}, {"box_center": None}),
    "score_2d": ({"score_2d": 0.61}, {"score_2d": 0.6}),
    "score_3d": ({"score_3d": 0.61}, {"score_3d": 0.6}),
    "viewpoint_deg": ({"extra": '{"expected_yaw_deg": -19.9}'}, {"extra": '{"expected_yaw_deg": 340.0}'}),
    # 300 x 300 px, as released: left of 100, right of 200, above and below 150
    "centred": (
        {"frame_width": 300, "frame_height": 300, "box2d": (100.0, 0.0, 200.0, 150.0)},
        {"frame_width": 300, "frame_height": 300, "box2d": (101.0, 0.0, 210.0, 200.0)},
    ),
}
NOT_BY_DEFAULT = {"centred": FilterRecipe(centred=True)}


@pytest.mark.parametrize("name", EDGE)
def test_each_filter_at_its_threshold(record: PatchRecord, name: str) -> None:
    passes, fails = EDGE[name]
    recipe = NOT_BY_DEFAULT.get(name, RECIPE)
    assert judge(replace(record, **passes), recipe).is_kept  # type: ignore[arg-type]
    verdict = judge(replace(record, **fails), recipe)  # type: ignore[arg-type]
    assert (verdict.is_kept, verdict.reason, verdict.failed) == (False, name, (name,))


def test_edge_table_names_every_filter(record: PatchRecord) -> None:
    assert [check.filter for check in judge(record, RECIPE).checks] == [f(record, RECIPE).filter for f in FILTERS]
    assert {f(record, RECIPE).filter for f in FILTERS} == set(EDGE)


def test_unknown_values_pass(record: PatchRecord) -> None:
    unknown = replace(record, score_mask=None, mask_ratio=None, box_iou=None)
    assert judge(unknown, RECIPE).is_kept
    without_box = replace(unknown, box_center=None, box_size=None, box_yaw=None)
    assert judge(without_box, replace(RECIPE, need_box3d=False)).is_kept


def test_all_failures_and_values_are_kept(record: PatchRecord) -> None:
    verdict = judge(replace(record, box2d=(0.0, 0.0, 20.0, 10.0), mask_ratio=0.5), RECIPE)
    assert verdict.reason == "height_px"
    assert verdict.failed == ("height_px", "width_px", "mask_ratio")
    values = {check.filter: (check.value, check.threshold) for check in verdict.checks}
    assert values["width_px"] == (20.0, 32.0)
    assert values["depth_m"] == (20.0, 50.0)


def test_thresholds_are_the_released_ones() -> None:
    kitti = {
        "types": ("Car",),
        "height_px": 64.0,
        "width_px": 32.0,
        "depth_m": 50.0,
        "score_mask": 0.6,
        "mask_ratio": 0.6,
    }
    dvm = kitti | {"width_px": 64.0, "score_2d": 0.6, "score_3d": 0.6, "viewpoint_deg": 20.0, "centred": True}
    assert {name: getattr(RECIPE, name) for name in kitti} == kitti
    assert not RECIPE.centred
    assert {name: getattr(DVM_CARS, name) for name in dvm} == dvm


@pytest.mark.parametrize(
    ("yaw_deg", "expected_deg", "difference"), [(170.0, -175.0, 15.0), (-179.0, 179.0, 2.0), (90.0, -90.0, 180.0)]
)
def test_viewpoints_are_compared_around_the_circle(
    record: PatchRecord, yaw_deg: float, expected_deg: float, difference: float
) -> None:
    seen = replace(record, box_yaw=math.radians(yaw_deg), extra=json.dumps({"expected_yaw_deg": expected_deg}))
    check = next(check for check in judge(seen, RECIPE).checks if check.filter == "viewpoint_deg")
    assert check.value == pytest.approx(difference)
