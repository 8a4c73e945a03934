"""Overlap of boxes and masks against counted cells, random points, scipy's Jaccard distance and symmetries."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import jaccard

from carstudio.geometry.overlap import box2d_area, box2d_intersection, box2d_iou, mask_iou
from oracles import geometry_slow

CORNERS = st.tuples(*[st.integers(0, 12)] * 4)


def boxes(*rows) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


@given(CORNERS, CORNERS)
def test_iou_is_the_count_of_cells_also_for_empty_boxes(a, b):
    expected = geometry_slow.rasterised_iou(a, b, 13)
    assert box2d_iou(boxes(a)[0], boxes(b)[0]).item() == pytest.approx(expected, abs=1e-12)


@given(st.integers(0, 10**6))
def test_areas_are_those_of_random_points(seed):
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 0.5, size=(2, 2))
    a, b = np.concatenate([low, low + rng.uniform(0.1, 0.5, size=(2, 2))], axis=1)
    points = rng.uniform(size=(40_000, 2))
    in_a, in_b = ((points > box[:2]).all(axis=1) & (points < box[2:]).all(axis=1) for box in (a, b))
    # 40,000 points of a unit square: four standard deviations are at most 0.01.
    assert box2d_area(torch.tensor(a)).item() == pytest.approx(in_a.mean(), abs=0.01)
    assert box2d_intersection(torch.tensor(a), torch.tensor(b)).item() == pytest.approx((in_a & in_b).mean(), abs=0.01)


def test_overlap_by_hand():
    a, b = boxes((0, 0, 4, 2))[0], boxes((2, 1, 6, 5))[0]
    assert box2d_area(a).item() == 8
    assert box2d_intersection(a, b).item() == 2
    assert box2d_iou(a, b).item() == pytest.approx(2 / 22)


@given(CORNERS, CORNERS, st.integers(-5, 5), st.integers(1, 4))
def test_iou_knows_no_order_place_or_scale(a, b, shift, scale):
    first, second = boxes(a)[0], boxes(b)[0]
    iou = box2d_iou(first, second)
    torch.testing.assert_close(box2d_iou(second, first), iou)
    torch.testing.assert_close(box2d_iou(first * scale + shift, second * scale + shift), iou)
    assert 0 <= iou <= 1


def test_touching_and_empty_boxes_do_not_overlap():
    assert box2d_iou(boxes((0, 0, 1, 1)), boxes((1, 0, 2, 1))).item() == 0
    assert box2d_iou(boxes((3, 3, 3, 3)), boxes((3, 3, 3, 3))).item() == 0
    assert box2d_area(boxes((5, 5, 1, 1))).item() == 0  # inverted in both axes: empty, not positive


def test_boxes_pair_by_broadcasting():
    a, b = torch.rand(4, 1, 4).cumsum(dim=-1), torch.rand(1, 3, 4).cumsum(dim=-1)
    table, common = box2d_iou(a, b), box2d_intersection(a, b)
    assert table.shape == common.shape == (4, 3)
    for i in range(4):
        for j in range(3):
            torch.testing.assert_close(table[i, j], box2d_iou(a[i, 0], b[0, j]))
            torch.testing.assert_close(common[i, j], box2d_intersection(a[i, 0], b[0, j]))


def test_iou_has_the_right_gradients():
    a = boxes((0.1, 0.2, 2.3, 3.1)).requires_grad_()
    b = boxes((0.6, 1.1, 4.0, 2.7)).requires_grad_()
    assert torch.autograd.gradcheck(box2d_iou, (a, b))


@given(st.integers(0, 10**6))
def test_mask_iou_is_scipys_jaccard(seed):
    rng = np.random.default_rng(seed)
    a, b = rng.random((2, 3, 7, 9)) < 0.5
    ours = mask_iou(torch.tensor(a), torch.tensor(b))
    for i in range(3):
        assert ours[i].item() == pytest.approx(1 - jaccard(a[i].ravel(), b[i].ravel()), abs=1e-6)
        both, either = 0, 0
        for x, y in zip(a[i].ravel(), b[i].ravel(), strict=True):
            both, either = both + (x and y), either + (x or y)
        assert ours[i].item() == pytest.approx(both / either, abs=1e-6)


def test_masks_that_agree_on_nothing_agree():
    empty, full = torch.zeros(1, 4, 4, dtype=torch.bool), torch.ones(1, 4, 4, dtype=torch.bool)
    assert mask_iou(empty, empty).item() == 1
    assert mask_iou(empty, full).item() == 0
    assert mask_iou(full, full).item() == 1
