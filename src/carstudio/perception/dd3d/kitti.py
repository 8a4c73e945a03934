"""Detections as KITTI's benchmark wants them: one line of 16 columns per box, all five classes."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.perception.dd3d.decoding import Detections
from carstudio.perception.dd3d.model import KITTI_CLASSES


def bottom_center(found: Detections) -> Float[Tensor, "box 3"]:
    """Centres of the bottom faces of upright boxes, m, in the frame of KITTI's labels."""
    half_height = torch.zeros_like(found.center)
    half_height[:, 1] = found.size[:, 2] / 2
    return found.center + half_height


def rotation_y(found: Detections) -> Float[Tensor, " box"]:
    """KITTI's yaw in rad: the whole turn away from an upright box of yaw 0, exact for upright boxes.

    This is the released evaluation's; `yaw_from_rotation` projects the heading of leaning boxes instead.
    """
    w, x, y, z = found.quaternion.unbind(-1)
    # Rx(-90 degrees) from the left carries the camera's axes (y down, z forward) onto the object's (z up).
    w, x, y, z = (w + x, x - w, y + z, z - y)  # times sqrt(1/2), which the angle does not feel
    angle = wrapped(2 * torch.atan2(torch.stack([x, y, z]).norm(dim=0), w))
    return torch.where(z > 0, -angle, angle)


def alpha(found: Detections) -> Float[Tensor, " box"]:
    """KITTI's observation angle in rad, rounded to hundredths as in its labels."""
    x, z = found.center[:, 0], found.center[:, 2]
    turn = torch.atan2(x.abs(), z.abs())
    angle = wrapped(rotation_y(found) + torch.where(x < 0, turn, -turn))
    return (angle * 100).round() / 100


def wrapped(angle: Float[Tensor, " box"]) -> Float[Tensor, " box"]:
    """The same angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def result_text(found: Detections) -> str:
    """Type, -1, -1, alpha, box (px, as they are), height, width, length, bottom centre, yaw, score of the 3-D box."""
    names = list(KITTI_CLASSES)
    place, yaw, observed = bottom_center(found), rotation_y(found), alpha(found)
    lines = []
    for i, kind in enumerate(found.kind.tolist()):
        width, length, height = found.size[i].tolist()
        numbers = [*found.box2d[i].tolist(), height, width, length, *place[i].tolist(), float(yaw[i])]
        written = " ".join(f"{number:.2f}" for number in numbers)
        lines.append(f"{names[kind]} -1 -1 {float(observed[i]):.2f} {written} {float(found.score_3d[i]):.4f}\n")
    return "".join(lines)
