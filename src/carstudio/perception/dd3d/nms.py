"""Which candidates stay: of boxes that show one object the one whose 3-D box is surest.

Suppression is by class. The released KITTI models suppress in the image alone; nuScenes' also from above.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from carstudio.geometry.birdseye import convex_iou
from carstudio.geometry.overlap import box2d_iou
from carstudio.geometry.transforms import rotation_from_quaternion
from carstudio.perception.dd3d.decoding import Detections
from carstudio.perception.suppression import survivors


@dataclass(frozen=True)
class Suppression:
    """How doubled boxes are told (the values of the released KITTI models)."""

    most_iou: float = 0.75
    """Of two boxes of a class that overlap more in the image, the better one stays."""
    most_iou_from_above: float | None = None
    """Of two boxes of a class that overlap more seen from above, the better one stays (nuScenes: 0.3)."""
    most_boxes: int = 100
    """So many at most: those with the best 2-D scores; ties at the end all stay."""


def settled(found: Detections, suppression: Suppression) -> Detections:
    """What stays of the candidates, the surest 3-D box first."""
    found = found.chosen(found.score_3d.argsort(descending=True, stable=True))
    found = found.chosen(kept_in_image(found, suppression.most_iou))
    if len(found) > suppression.most_boxes:
        least = found.score_2d.topk(suppression.most_boxes).values[-1]
        found = found.chosen(found.score_2d >= least)
    if suppression.most_iou_from_above is not None:
        found = found.chosen(kept_from_above(found, suppression.most_iou_from_above))
    return found


def kept_in_image(found: Detections, most_iou: float) -> Int[Tensor, " kept"]:
    """Numbers of the boxes, ordered best first, that overlap no better one of their class too much in the image."""
    return _kept_by_class(found, lambda rows: box2d_iou(found.box2d[rows, None], found.box2d[None, rows]) > most_iou)


def kept_from_above(found: Detections, most_iou: float) -> Int[Tensor, " kept"]:
    """The same from above."""
    seen = from_above(found)
    return _kept_by_class(found, lambda rows: convex_iou(seen[rows, None], seen[None, rows]) > most_iou)


def _kept_by_class(found: Detections, repeats: Callable[[Tensor], Bool[Tensor, "n n"]]) -> Int[Tensor, " kept"]:
    kept = torch.zeros(len(found), dtype=torch.bool, device=found.kind.device)
    for kind in found.kind.unique().tolist():
        rows = torch.nonzero(found.kind == kind)[:, 0]
        kept[rows] = survivors(repeats(rows))
    return torch.nonzero(kept)[:, 0]


def from_above(found: Detections) -> Float[Tensor, "box 4 2"]:
    """Corners of the top faces' rectangles on the ground plane (camera x, z; m), going around.

    Of a box that leans: the rectangle with the lengths of its two edges as seen from above, along the front one.
    """
    rotation = rotation_from_quaternion(found.quaternion)
    width, length, height = found.size.unbind(-1)
    front, left, up = (rotation[..., (0, 2), axis] for axis in range(3))
    center = found.center[:, (0, 2)] + up * height[:, None] / 2
    half_length = front.norm(dim=-1) * length / 2
    half_width = left.norm(dim=-1) * width / 2
    ahead = torch.nn.functional.normalize(front, dim=-1)
    aside = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=-1) * half_width[:, None]
    ahead = ahead * half_length[:, None]
    return torch.stack(
        [center + ahead + aside, center + ahead - aside, center - ahead - aside, center - ahead + aside], dim=1
    )
