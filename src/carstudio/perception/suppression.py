"""Non-maximum suppression: of boxes that show one object the surest stays."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from carstudio.geometry.overlap import box2d_iou


def without_doubles(boxes: Float[np.ndarray, "n 4"], order: Sequence[int], most_iou: float) -> list[int]:
    """Of `order`, those that overlap no earlier one that stays by more than `most_iou`."""
    chosen = torch.from_numpy(boxes[list(order)])
    iou = box2d_iou(chosen[:, None], chosen[None])
    kept: list[int] = []
    for row in range(len(order)):
        if not (iou[row, kept] > most_iou).any():
            kept.append(row)
    return [order[row] for row in kept]
