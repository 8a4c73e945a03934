"""Labels of drawn objects: boxes counted, outlines cut by the border, lines that our own KITTI reader understands."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from carstudio.dataset.sources.kitti_format import center_in_camera, parse_label
from carstudio.geometry.camera import Camera
from carstudio.scene.footprint import outline_mask
from carstudio.scene.frame_jobs import PlacedObject
from carstudio.scene.truth import (
    bounding_box,
    label_line,
    occlusion_level,
    truncation_of,
    truth_of,
)
from scene.toy_log import HEIGHT_M, SIZE, placed

CAMERA = Camera(torch.tensor([120.0, 120.0, 80.0, 40.0]), 160, 96)


def test_a_bounding_box_is_whole_pixels():
    mask = np.zeros((20, 30), bool)
    mask[3:8, 5:9] = True
    assert bounding_box(mask) == (5.0, 3.0, 9.0, 8.0)
    assert bounding_box(mask & False) is None


@pytest.mark.parametrize(("share", "level"), [(1.0, 0), (0.9, 0), (0.89, 1), (0.5, 1), (0.49, 2), (0.0, 2)])
def test_levels_of_occlusion(share, level):
    assert occlusion_level(share) == level


@pytest.mark.parametrize("place", [(-4.6, 7.0), (5.5, 7.5), (0.0, 3.2), (1.0, 12.0)])
def test_truncation_is_the_share_of_pixels_outside(place):
    box = placed(*place, -1.2)
    margin = 600
    wide = outline_mask(box, CAMERA.crop(-margin, -margin, 160 + 2 * margin, 96 + 2 * margin))
    inside = wide[margin : margin + 96, margin : margin + 160].sum()
    assert truncation_of(box, CAMERA) == pytest.approx(1 - inside / wide.sum(), abs=0.03)  # pixels that the rim touches


def test_what_is_out_of_view_is_truncated_whole():
    assert truncation_of(placed(0.0, -9.0), CAMERA) == 1.0
    assert truncation_of(placed(50.0, 9.0), CAMERA) == pytest.approx(1.0)


def an_object(**changes) -> PlacedObject:
    basis = PlacedObject(track_id="5", number=3, type="Car", box=placed(1.0, 9.0, 0.7), car=None, is_drawn=True)
    return replace(basis, **changes)


def test_a_label_line_is_read_back_as_the_same_box():
    instances = np.zeros((96, 160), np.uint16)
    instances[50:60, 70:90] = 3
    alone = (instances > 0).astype(np.float32)
    truth = truth_of(an_object(), CAMERA, instances, alone, instances > 0)
    offset = (0.06, -0.001, 0.003)
    line = label_line(truth, offset)
    assert line is not None
    label = parse_label(line, where="test")
    assert label.box2d == (70.0, 50.0, 90.0, 60.0)
    assert label.size == pytest.approx(SIZE)
    assert label.yaw_rad == pytest.approx(0.7, abs=1e-5)
    assert center_in_camera(label, offset) == pytest.approx((1.0, HEIGHT_M - SIZE[1] / 2, 9.0), abs=1e-5)
    assert label.occlusion == 0


def test_nobody_labels_what_nobody_sees():
    nothing = np.zeros((96, 160), np.uint16)
    truth = truth_of(an_object(), CAMERA, nothing, np.zeros((96, 160), np.float32), nothing > 0)
    assert truth.box2d is None
    assert label_line(truth, (0.0, 0.0, 0.0)) is None


def test_an_object_without_a_car_keeps_its_label_until_drawn_cars_hide_it():
    label = {"box2d": [60.0, 30.0, 120.0, 70.0], "occlusion": 1}
    untouched = an_object(is_drawn=False, label=label)
    nothing = np.zeros((96, 160), bool)
    free = truth_of(untouched, CAMERA, nothing.astype(np.uint16), None, nothing)
    assert (free.box2d, free.occlusion, free.num_pixels) == ((60.0, 30.0, 120.0, 70.0), 1, None)
    left = nothing.copy()
    left[:, :95] = True
    hidden = truth_of(untouched, CAMERA, nothing.astype(np.uint16), None, left)
    share = (outline_mask(untouched.box, CAMERA) & left).sum() / outline_mask(untouched.box, CAMERA).sum()
    assert 0.1 < share < 0.9
    assert hidden.box2d is not None
    assert hidden.box2d[0] == 95.0
    assert hidden.occlusion == max(1, occlusion_level(1 - share))
    assert truth_of(replace(untouched, label=None), CAMERA, nothing.astype(np.uint16), None, nothing).occlusion == 3
