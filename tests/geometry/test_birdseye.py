"""Overlap of convex polygons against clipping in loops, samples, and cases known by hand."""

import math

import numpy as np
import pytest
import torch

from carstudio.geometry.birdseye import convex_area, convex_intersection, convex_iou
from oracles.dd3d_slow import polygon_iou


def rectangle(x: float, y: float, length: float, width: float, angle: float) -> list[tuple[float, float]]:
    c, s = math.cos(angle), math.sin(angle)
    corners = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return [
        (x + c * i * length / 2 - s * j * width / 2, y + s * i * length / 2 + c * j * width / 2) for i, j in corners
    ]


def drawn(count: int) -> list[list[tuple[float, float]]]:
    rng = np.random.default_rng(0)
    rows = zip(rng.normal(0, 1.5, (count, 2)), rng.uniform(0.3, 5, (count, 2)), rng.uniform(-4, 4, count), strict=True)
    return [rectangle(*place, *size, angle) for place, size, angle in rows]


def test_iou_equals_clipping_in_loops() -> None:
    boxes = drawn(25)
    polygons = torch.tensor(boxes, dtype=torch.float64)
    found = convex_iou(polygons[:, None], polygons[None])
    expected = [[polygon_iou(a, b) for b in boxes] for a in boxes]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert 0.2 < (found > 0.01).double().mean() < 0.98  # both kinds are drawn


def test_the_common_area_is_that_of_samples() -> None:
    a, b = (torch.tensor(box, dtype=torch.float64) for box in drawn(9)[7:])
    points = torch.from_numpy(np.random.default_rng(1).uniform(-6, 6, (400_000, 2)))

    def holds(polygon: torch.Tensor) -> torch.Tensor:
        edges = polygon.roll(-1, dims=0) - polygon
        offset = points[:, None] - polygon
        return (edges[:, 0] * offset[..., 1] - edges[:, 1] * offset[..., 0] <= 0).all(dim=1)  # these go clockwise

    share = (holds(a) & holds(b)).double().mean()
    deviation = 144 * float((share * (1 - share) / len(points)).sqrt())
    assert float(convex_intersection(a, b)) == pytest.approx(144 * float(share), abs=4 * deviation)
    assert share > 0.001


@pytest.mark.parametrize("angle", [0.0, 0.3, math.pi / 2, 2.0])
def test_cases_known_by_hand(angle: float) -> None:
    def at(x: float, y: float, length: float, width: float, more: float = 0.0) -> torch.Tensor:
        c, s = math.cos(angle), math.sin(angle)
        return torch.tensor(rectangle(c * x - s * y, s * x + c * y, length, width, angle + more), dtype=torch.float64)

    base = at(0, 0, 4, 2)
    assert float(convex_area(base)) == pytest.approx(8)
    for other, common in (
        (base, 8),  # itself
        (at(0, 0, 4, 2, math.pi), 8),  # turned around: corners in another order
        (base.flip(0), 8),  # the other way around
        (at(4, 0, 4, 2), 0),  # they share an edge
        (at(4, 2, 4, 2), 0),  # they share a corner
        (at(1, 0, 4, 2), 6),  # they share parts of two edges
        (at(0.2, 0.3, 1, 1), 1),  # inside
        (at(0, 0, 9, 9), 8),  # around
        (at(9, 0, 4, 2), 0),  # apart
        (at(0, 0, 4, 2, math.pi / 2), 4),  # crossed
        (at(0, 0, math.sqrt(2), math.sqrt(2), math.pi / 4), 2),  # on its tip, touching two edges
    ):
        assert float(convex_intersection(base, other)) == pytest.approx(common, abs=1e-7)
        assert float(convex_intersection(other, base)) == pytest.approx(common, abs=1e-7)
