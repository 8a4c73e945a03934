"""Non-maximum suppression: of boxes that show one object the surest stays."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from carstudio.geometry.overlap import box2d_iou


def without_doubles(boxes: Float[np.ndarray, "n 4"], order: Sequence[int], most_iou: float) -> list[int]:
    """Of `order`, those that overlap no earlier one that stays by more than `most_iou`."""
    chosen = torch.from_numpy(boxes[list(order)])
    stays = survivors(box2d_iou(chosen[:, None], chosen[None]) > most_iou)
    return [number for number, is_kept in zip(order, stays.tolist(), strict=True) if is_kept]


def survivors(repeats: Bool[Tensor, "n n"]) -> Bool[Tensor, " n"]:
    """Which of n things, best first, repeat no earlier one that survives; `repeats[i, j]`: i and j show one thing.

    All are asked at once who survives if those before are the survivors of the last round. After k rounds the first
    k answers are final, and most chains of repetitions are short: a few rounds instead of n steps.
    """
    earlier = repeats.triu(diagonal=1)
    kept = torch.ones(len(repeats), dtype=torch.bool, device=repeats.device)
    while True:
        now = ~earlier[kept].any(dim=0)
        if torch.equal(now, kept):
            return kept
        kept = now
