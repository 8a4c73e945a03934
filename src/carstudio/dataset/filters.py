"""The filters between a candidate and a kept patch: pure functions of a record (Car-Studio section 3, "filters").

Each measures one value against one threshold. A value the source does not know (None) passes: a filter rejects what it
has seen. So a segmenter without a confidence (GrabCut) is judged by the mask's share of the box alone.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.verdicts import KEPT, Check, Verdict
from carstudio.files import parse_json


@dataclass(frozen=True)
class FilterRecipe:
    """Thresholds; the defaults are the released code's where it has one."""

    types: tuple[str, ...] = ("Car",)
    """Label types that are kept (released: Car)."""
    height_px: float = 64.0
    """Least height of the 2-D box, px (released)."""
    width_px: float = 32.0
    """Least width of the 2-D box, px (released)."""
    depth_m: float = 50.0
    """Greatest depth of the 3-D box's centre, camera z, m (released)."""
    score_2d: float = 0.6
    """The 2-D detector's confidence must be above this (released for DVM-Cars)."""
    score_3d: float = 0.6
    """The confidence in the 3-D box must be above this (released for DVM-Cars)."""
    score_mask: float = 0.6
    """The segmenter's confidence must be above this (released: SAM's predicted IoU)."""
    mask_ratio: float = 0.6
    """Car pixels / pixels of the 2-D box must be above this (released)."""
    box_iou: float = 0.7
    """Least IoU of 2-D box and envelope of the projected 3-D box (the paper's filter 1, which gives no number).
    KITTI's labels reach 0.84 to 1 but for a few cars cut off by the image border (0.53, 0.54); 0.7 is the overlap that
    KITTI's own benchmark calls a match for cars."""
    viewpoint_deg: float = 20.0
    """Greatest difference of the 3-D box's yaw and the one that the source tells (released for DVM-Cars, deg)."""
    centred: bool = False
    """Reject cars that do not span the photograph's centre: its middle third in width, its middle line in height
    (released for DVM-Cars, whose photographs are of 300 x 300 px)."""
    need_box3d: bool = True
    """Reject patches without a 3-D box: nothing can be trained on them."""
    drop_duplicates: bool = False
    """Reject patches whose picture repeats a kept one's; `carstudio dataset duplicates` must have looked for them."""


DVM_CARS = FilterRecipe(width_px=64.0, centred=True)
"""The rules that were released for DVM-Cars."""
EXPECTED_YAW = "expected_yaw_deg"  # in `extra`: what the source says of the viewpoint
Filter = Callable[[PatchRecord, FilterRecipe], Check]


def check_type(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The label's type is one of the recipe's."""
    label_type = _extra(record).get("type")
    return Check("type", None, None, label_type is None or label_type in recipe.types)


def _extra(record: PatchRecord) -> dict[str, Any]:
    extra = parse_json(record.extra, name=f"extra of patch {record.patch_id}")
    return extra if isinstance(extra, dict) else {}


def check_box3d(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """There is a 3-D box."""
    has_box = record.box_center is not None
    return Check("box3d", float(has_box), float(recipe.need_box3d), has_box or not recipe.need_box3d)


def check_height(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The 2-D box is tall enough."""
    value = record.box2d[3] - record.box2d[1]
    return Check("height_px", value, recipe.height_px, value >= recipe.height_px)


def check_width(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The 2-D box is wide enough."""
    value = record.box2d[2] - record.box2d[0]
    return Check("width_px", value, recipe.width_px, value >= recipe.width_px)


def check_depth(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The car is near enough."""
    value = None if record.box_center is None else record.box_center[2]
    return Check("depth_m", value, recipe.depth_m, value is None or value <= recipe.depth_m)


def check_box_iou(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """2-D and 3-D box agree in the image."""
    value = record.box_iou
    return Check("box_iou", value, recipe.box_iou, value is None or value >= recipe.box_iou)


def check_score_2d(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The 2-D detector is confident."""
    value = record.score_2d
    return Check("score_2d", value, recipe.score_2d, value is None or value > recipe.score_2d)


def check_score_3d(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """Who found the 3-D box is confident."""
    value = record.score_3d
    return Check("score_3d", value, recipe.score_3d, value is None or value > recipe.score_3d)


def check_centred(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The car is what the photograph was taken of."""
    if record.frame_width is None or record.frame_height is None:
        return Check("centred", None, None, True)
    x0, y0, x1, y1 = record.box2d
    third, half = record.frame_width / 3, record.frame_height / 2
    spans = x0 <= third and x1 >= 2 * third and y0 <= half <= y1
    return Check("centred", float(spans), float(recipe.centred), spans or not recipe.centred)


def check_viewpoint(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The 3-D box is seen from where the source says that the car is seen from."""
    expected = _extra(record).get(EXPECTED_YAW)
    if expected is None or record.box_yaw is None:
        return Check("viewpoint_deg", None, recipe.viewpoint_deg, True)
    value = abs((math.degrees(record.box_yaw) - float(expected) + 180.0) % 360.0 - 180.0)
    return Check("viewpoint_deg", value, recipe.viewpoint_deg, value < recipe.viewpoint_deg)


def check_score_mask(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The segmenter is confident."""
    value = record.score_mask
    return Check("score_mask", value, recipe.score_mask, value is None or value > recipe.score_mask)


def check_mask_ratio(record: PatchRecord, recipe: FilterRecipe) -> Check:
    """The car fills its box: not occluded, not missed by the segmenter."""
    value = record.mask_ratio
    return Check("mask_ratio", value, recipe.mask_ratio, value is None or value > recipe.mask_ratio)


# The order in which a reason is looked for: what the label says before what the segmenter found.
FILTERS: tuple[Filter, ...] = (
    check_type,
    check_box3d,
    check_height,
    check_width,
    check_depth,
    check_centred,
    check_score_2d,
    check_score_3d,
    check_box_iou,
    check_viewpoint,
    check_score_mask,
    check_mask_ratio,
)


def judge(record: PatchRecord, recipe: FilterRecipe) -> Verdict:
    """All filters on one record; the pictures are not looked at."""
    checks = tuple(check(record, recipe) for check in FILTERS)
    failed = tuple(check.filter for check in checks if not check.is_passed)
    return Verdict(record.patch_id, not failed, failed[0] if failed else KEPT, failed, checks)
