"""Overlap of 2-D boxes (x0, y0, x1, y1 px) and of masks."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def box2d_area(boxes: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch"]:
    """Area in px^2, 0 for an empty box."""
    return (boxes[..., 2:] - boxes[..., :2]).clamp(min=0).prod(dim=-1)


def box2d_intersection(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch"]:
    """Area of the common part in px^2, pairwise with broadcasting."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    return (high - low).clamp(min=0).prod(dim=-1)


def box2d_iou(a: Float[Tensor, "*#batch 4"], b: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*batch"]:
    """Intersection over union, pairwise with broadcasting; 0 where both are empty."""
    a, b = torch.broadcast_tensors(a, b)
    common = box2d_intersection(a, b)
    union = box2d_area(a) + box2d_area(b) - common
    return torch.where(union > 0, common / union.clamp(min=1e-12), torch.zeros_like(union))


def mask_iou(a: Bool[Tensor, "*batch height width"], b: Bool[Tensor, "*batch height width"]) -> Float[Tensor, "*batch"]:
    """Intersection over union of masks; 1 where both are empty (they agree)."""
    common = (a & b).sum(dim=(-2, -1)).float()
    union = (a | b).sum(dim=(-2, -1)).float()
    return torch.where(union > 0, common / union.clamp(min=1), torch.ones_like(union))
