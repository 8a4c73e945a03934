"""Overlap of convex polygons, such as boxes seen from above."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ON_THE_EDGE = 1e-9  # m^2: cross products so small count as zero; repeated points do no harm


def convex_area(polygons: Float[Tensor, "*batch corners 2"]) -> Float[Tensor, "*batch"]:
    """Area of polygons whose corners go around in either direction."""
    return _cross(polygons, polygons.roll(-1, dims=-2)).sum(dim=-1).abs() / 2


def convex_intersection(a: Float[Tensor, "*#batch n 2"], b: Float[Tensor, "*#batch m 2"]) -> Float[Tensor, "*batch"]:
    """Area common to convex polygons, pairwise with broadcasting; computed in float64.

    Its corners are those corners of each that lie in the other, and where their edges cross.
    """
    a, b = a.double(), b.double()
    batch = torch.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = a.expand(*batch, *a.shape[-2:]), b.expand(*batch, *b.shape[-2:])
    crossings, is_crossing = _edge_crossings(a, b)
    points = torch.cat([a, b, crossings], dim=-2)
    is_corner = torch.cat([_inside(a, b), _inside(b, a), is_crossing], dim=-1)
    first = torch.take_along_dim(points, is_corner.int().argmax(dim=-1)[..., None, None], dim=-2)
    points = torch.where(is_corner[..., None], points, first)  # what is no corner repeats one, or all are one point
    around = points - points.mean(dim=-2, keepdim=True)
    order = torch.atan2(around[..., 1], around[..., 0]).argsort(dim=-1)
    area = convex_area(torch.take_along_dim(around, order[..., None], dim=-2))
    return torch.where(is_corner.any(dim=-1), area, torch.zeros_like(area))


def convex_iou(a: Float[Tensor, "*#batch n 2"], b: Float[Tensor, "*#batch m 2"]) -> Float[Tensor, "*batch"]:
    """Intersection over union of convex polygons, pairwise with broadcasting; 0 where both are empty."""
    common = convex_intersection(a, b)
    union = convex_area(a.double()) + convex_area(b.double()) - common
    return torch.where(union > 0, common / union.clamp(min=1e-12), torch.zeros_like(union))


def _cross(a: Float[Tensor, "*#batch 2"], b: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*batch"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _inside(points: Float[Tensor, "*batch n 2"], polygon: Float[Tensor, "*batch m 2"]) -> Bool[Tensor, "*batch n"]:
    """Whether points lie on the inner side of all edges, or on an edge."""
    edges = polygon.roll(-1, dims=-2) - polygon
    winding = _cross(polygon, polygon.roll(-1, dims=-2)).sum(dim=-1).sign()
    side = _cross(edges[..., None, :, :], points[..., :, None, :] - polygon[..., None, :, :])
    return (side * winding[..., None, None] >= -ON_THE_EDGE).all(dim=-1)


def _edge_crossings(
    a: Float[Tensor, "*batch n 2"], b: Float[Tensor, "*batch m 2"]
) -> tuple[Float[Tensor, "*batch nm 2"], Bool[Tensor, "*batch nm"]]:
    """Where each edge of `a` meets each of `b`, and whether it does; parallel edges do not."""
    start, along = a[..., :, None, :], (a.roll(-1, dims=-2) - a)[..., :, None, :]
    other, across = b[..., None, :, :], (b.roll(-1, dims=-2) - b)[..., None, :, :]
    turn = _cross(along, across)
    is_parallel = turn.abs() < ON_THE_EDGE
    safe = torch.where(is_parallel, torch.ones_like(turn), turn)
    t, u = _cross(other - start, across) / safe, _cross(other - start, along) / safe
    meets = ~is_parallel & (t >= 0) & (t <= 1) & (u >= 0) & (u <= 1)
    return (start + t[..., None] * along).flatten(-3, -2), meets.flatten(-2)
