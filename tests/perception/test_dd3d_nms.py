"""Suppression against one box after the other."""

import math

import numpy as np
import pytest
import torch

from carstudio.geometry.transforms import quaternion_from_rotation
from carstudio.perception.dd3d.decoding import Detections
from carstudio.perception.dd3d.nms import Suppression, from_above, kept_from_above, kept_in_image, settled
from carstudio.perception.suppression import survivors
from oracles import dd3d_slow as slow


def crowd(count: int, seed: int = 0) -> Detections:
    """Boxes in a few heaps, of three classes, in no order."""
    rng = np.random.default_rng(seed)
    heap = rng.integers(0, 6, count)
    corner = np.stack([heap * 40.0, heap * 10.0], axis=1) + rng.normal(0, 4, (count, 2)) - 30
    yaw = heap + rng.normal(0, 0.1, count)
    rotations = [slow.turn(1, angle) @ slow.turn(0, math.pi / 2) for angle in yaw]
    score = torch.from_numpy(rng.permutation(count) / count * 0.9 + 0.05).float()
    return Detections(
        box2d=torch.from_numpy(np.concatenate([corner, corner + 30 + rng.normal(0, 3, (count, 2))], axis=1)).float(),
        score_2d=score.roll(1),
        score_3d=score,
        kind=torch.from_numpy(rng.integers(0, 3, count)),
        level=torch.zeros(count, dtype=torch.long),
        cell=torch.arange(count),
        quaternion=quaternion_from_rotation(torch.from_numpy(np.array(rotations))).float(),
        projected_center=torch.zeros(count, 2),
        center=torch.from_numpy(np.stack([heap * 3.0, heap * 0.0, 10 + heap], axis=1) + rng.normal(0, 0.4, (count, 3)))
        .float(),
        size=torch.from_numpy(rng.uniform(1.5, 4, (count, 3))).float(),
    )  # fmt: skip


def best_first(found: Detections) -> Detections:
    return found.chosen(found.score_3d.argsort(descending=True))


def test_survivors_are_those_of_one_after_the_other() -> None:
    rng = np.random.default_rng(0)
    for share in (0.0, 0.02, 0.1, 0.5, 1.0):
        for count in (0, 1, 2, 7, 60):
            upper = np.triu(rng.random((count, count)) < share, 1)
            repeats = upper | upper.T
            expected = slow.suppress([0] * count, repeats.tolist(), 0.5)
            assert torch.nonzero(survivors(torch.from_numpy(repeats)))[:, 0].tolist() == expected


def test_a_long_chain_of_repetitions() -> None:
    """Each repeats the next: every other one survives, however long it is."""
    near = torch.arange(101)
    repeats = (near[:, None] - near[None]).abs() == 1
    assert survivors(repeats).tolist() == [i % 2 == 0 for i in range(101)]


@pytest.mark.parametrize("most_iou", [0.3, 0.6, 0.75])
def test_in_the_image(most_iou: float) -> None:
    found = best_first(crowd(150))
    boxes = found.box2d.double().tolist()
    iou = [[slow.box_iou(a, b) for b in boxes] for a in boxes]
    expected = slow.suppress(found.kind.tolist(), iou, most_iou)
    assert kept_in_image(found, most_iou).tolist() == expected
    assert 10 < len(expected) < 140


def test_from_above() -> None:
    found = best_first(crowd(80))
    polygons = [[(float(x), float(z)) for x, z in corners] for corners in from_above(found)]
    iou = [[slow.polygon_iou(a, b) for b in polygons] for a in polygons]
    expected = slow.suppress(found.kind.tolist(), iou, 0.3)
    assert kept_from_above(found, 0.3).tolist() == expected
    assert 10 < len(expected) < 75


def test_an_upright_box_from_above_is_its_footprint() -> None:
    found = crowd(1)
    rotation = slow.kitti_object_rotation(0.5)
    found = Detections(**{**vars(found), "quaternion": torch.from_numpy(slow.quaternion_of(rotation)[None]).float()})
    width, length, _ = found.size[0].tolist()
    corners = [
        found.center[0].numpy() + rotation @ [x * length / 2, y * width / 2, 0.0]
        for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    expected = np.array(corners)[:, [0, 2]]
    distance = np.linalg.norm(from_above(found)[0].numpy()[:, None] - expected, axis=-1)  # as sets of corners
    assert distance.min(axis=0).max() < 1e-5
    assert distance.min(axis=1).max() < 1e-5


def test_settled_orders_suppresses_and_keeps_the_best_of_the_image() -> None:
    found = crowd(150)
    stay = settled(found, Suppression(most_iou=0.6, most_boxes=12))
    boxes = best_first(found)
    all_kept = boxes.chosen(kept_in_image(boxes, 0.6))
    least = sorted(all_kept.score_2d.tolist())[-12]
    expected = [cell for cell, s in zip(all_kept.cell.tolist(), all_kept.score_2d.tolist(), strict=True) if s >= least]
    assert stay.cell.tolist() == expected
    assert len(expected) == 12
    assert len(settled(found, Suppression(most_iou=0.6, most_iou_from_above=0.3))) < len(all_kept)
    assert len(settled(found.chosen(torch.zeros(0, dtype=torch.long)), Suppression())) == 0


def test_ties_at_the_end_all_stay() -> None:
    found = crowd(40)
    found = Detections(**{**vars(found), "score_2d": torch.full((40,), 0.5)})
    assert len(settled(found, Suppression(most_iou=1.0, most_boxes=10))) == 40
