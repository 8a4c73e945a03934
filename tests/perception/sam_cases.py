"""Photographs, requests and oracles for SAM and SAM 2."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from carstudio.perception.results import Box2D, MaskResult, SegmentRequest, Window
from oracles.resize import bilinear
from perception.tiny_hub import photograph

SHAPES = [(50, 90), (96, 60), (64, 64), (201, 83)]
SHARES = [(0.1, 0.2, 0.6, 0.9), (0.5, 0.05, 0.97, 0.55), (0.3, 0.3, 0.45, 0.5)]


def boxes_of(shape: tuple[int, int]) -> list[Box2D]:
    height, width = shape
    return [(a * width, b * height, c * width, d * height) for a, b, c, d in SHARES]


def requests_of(image: np.ndarray, boxes: Sequence[Box2D]) -> list[SegmentRequest]:
    """Windows of other sizes than the boxes: the cut must be right by itself."""
    height, width = image.shape[:2]
    requests = []
    for x0, y0, x1, y1 in boxes:
        left, top = max(0, int(x0) - 3), max(0, int(y0) - 5)
        window = Window(left, top, min(width, int(x1) + 4) - left, min(height, int(y1) + 2) - top)
        requests.append(SegmentRequest(image=image, window=window, box2d=(x0, y0, x1, y1)))
    return requests


def direct(network: nn.Module, pixels: torch.Tensor, box: Sequence[float], multimask: bool) -> tuple[np.ndarray, float]:
    """One box, one forward pass from the photograph: (mask logits at low size, predicted IoU) of the best mask."""
    with torch.no_grad():
        prompt = torch.tensor([[list(map(float, box))]])
        output = network(pixel_values=pixels, input_boxes=prompt, multimask_output=multimask)
    scores = output.iou_scores[0, 0].tolist()
    best = scores.index(max(scores))
    return output.pred_masks[0, 0, best].numpy(), scores[best]


def assert_same(result: MaskResult, logits: np.ndarray, score: float, request: SegmentRequest) -> None:
    """The mask is `logits` > 0 in the window, but where they are 0 within rounding."""
    cut = logits[request.window.slices]
    is_sure = np.abs(cut) > 1e-4 * np.abs(logits).max()
    assert is_sure.mean() > 0.99
    np.testing.assert_array_equal(result.car[is_sure], cut[is_sure] > 0)
    assert not result.unknown.any()
    assert result.score is not None
    assert abs(result.score - min(max(score, 0.0), 1.0)) < 1e-5


def grown(logits: np.ndarray, side: int, resized: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """SAM's way up: to the square, without its padding, to the photograph; in float64 loops."""
    return bilinear(bilinear(logits, (side, side))[: resized[0], : resized[1]], shape)


def photographs() -> list[np.ndarray]:
    return [photograph(*shape, seed=i) for i, shape in enumerate(SHAPES)]
