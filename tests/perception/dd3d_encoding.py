"""What a perfect DD3D would say of a labelled box: its raw outputs in one cell, by the slow oracle's angles."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from carstudio.perception.dd3d.heads import HeadOutputs
from carstudio.perception.dd3d.model import KITTI_CLASSES
from oracles import dd3d_slow as slow

CANONICAL = list(KITTI_CLASSES.values())
CHANNELS = {
    "logits": 5, "centerness": 1, "box2d": 4, "quaternion": 20, "center": 10, "depth": 5, "size": 15, "confidence": 5,
}  # fmt: skip


@dataclass(frozen=True)
class Said:
    """A box as KITTI's labels have it, in px and metres of the camera that the network is told of."""

    kind: int
    rotation: np.ndarray  # camera from object
    center: np.ndarray
    size: tuple[float, float, float]  # length, height, width
    sides: tuple[float, float, float, float]  # 2-D box: left, top, right, bottom


def silent_outputs(rows: int, columns: int) -> HeadOutputs:
    """Nothing is found."""
    values = {name: torch.zeros(1, count, rows, columns) for name, count in CHANNELS.items()}
    return HeadOutputs(**(values | {"logits": torch.full((1, 5, rows, columns), -20.0)}))


def say(outputs: HeadOutputs, stride: int, intrinsics: Sequence[float], box: Said, place: tuple[int, int]) -> None:
    """Let the cell at `place` (row, column) say this box and be sure of it."""
    fx, fy, cx, cy = intrinsics
    row, column = place
    u, v = fx * box.center[0] / box.center[2] + cx, fy * box.center[1] / box.center[2] + cy
    length, height, width = box.size
    x, y = column * stride, row * stride
    by_class = {
        "quaternion": 3.7 * slow.quaternion_of(slow.pointed_at(box.center).T @ box.rotation),
        "center": [u - x, v - y],
        "depth": [box.center[2] * 500 * math.hypot(1 / fx, 1 / fy)],
        "size": [math.atanh(a / b - 1) for a, b in zip((width, length, height), CANONICAL[box.kind], strict=True)],
        "confidence": [20.0],
        "logits": [20.0],
    }
    for name, components in by_class.items():
        for c, value in enumerate(components):
            getattr(outputs, name)[0, c * 5 + box.kind, row, column] = float(value)
    outputs.centerness[0, 0, row, column] = 20.0
    left, top, right, bottom = box.sides
    outputs.box2d[0, :, row, column] = torch.tensor([x - left, y - top, right - x, bottom - y])
