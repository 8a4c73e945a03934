"""From raw outputs of the heads to 3-D boxes (DD3D section 3.1 and its appendix).

A cell's location is (column, row) x stride, px of the network's input. Which cells become candidates is decided for all
levels at once; only candidates are decoded. Axes of an object: x to its front, y to its left, z up.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from carstudio.perception.dd3d.heads import HeadOutputs

REFERENCE_PIXEL = 1 / 500  # the camera for which the network predicts depth has pixels of this size at 1 m
NEAREST_M, FARTHEST_M = 0.1, 80.0
_BY_CLASS = ("quaternion", "center", "depth", "size", "confidence")


@dataclass(frozen=True)
class Selection:
    """Which cells become candidates (the values of the released KITTI models)."""

    least_score: float = 0.05
    """class x centerness must be above this."""
    most_per_level: int = 1000
    """So many of a level at most, the surest."""


@dataclass(frozen=True)
class Detections:
    """Boxes found in one photo; px of the network's input unless said otherwise, metres of its camera's frame."""

    box2d: Float[Tensor, "box 4"]  # x0, y0, x1, y1
    score_2d: Float[Tensor, " box"]  # sqrt(class x centerness)
    score_3d: Float[Tensor, " box"]  # the same times the confidence in the 3-D box
    kind: Int[Tensor, " box"]  # number of the class
    level: Int[Tensor, " box"]  # where it was found: level of the pyramid,
    cell: Int[Tensor, " box"]  # and number of the cell in it, row by row
    quaternion: Float[Tensor, "box 4"]  # w, x, y, z with w >= 0: camera from object
    projected_center: Float[Tensor, "box 2"]
    center: Float[Tensor, "box 3"]  # m
    size: Float[Tensor, "box 3"]  # width, length, height, m

    def __len__(self) -> int:
        return len(self.kind)

    def chosen(self, which: Tensor) -> "Detections":
        """Some of them, by their numbers or by a mask."""
        return Detections(*(getattr(self, field.name)[which] for field in fields(self)))


def candidates(
    outputs: Sequence[HeadOutputs],
    strides: Sequence[int],
    camera: Camera,
    canonical_sizes: Float[Tensor, "classes 3"],
    selection: Selection,
) -> list[Detections]:
    """All boxes worth looking at, of each photo of the batch, by level, cell and class.

    `camera` is the batch's, of the network's input; `canonical_sizes` are (width, length, height) in m.
    """
    flat = {
        field.name: torch.cat([getattr(level, field.name).flatten(2) for level in outputs], dim=2).float().mT
        for field in fields(HeadOutputs)
    }
    grids = [level.logits.shape[-2:] for level in outputs]
    places = [_locations(rows, columns, stride) for (rows, columns), stride in zip(grids, strides, strict=True)]
    level = torch.cat([torch.full((len(place),), i) for i, place in enumerate(places)])
    cell = torch.cat([torch.arange(len(place)) for place in places])
    device = camera.intrinsics.device
    level, cell, location = level.to(device), cell.to(device), torch.cat(places).to(device)
    scores = flat["logits"].sigmoid() * flat["centerness"].sigmoid()
    found = []
    for photo, score in enumerate(scores):
        where, kind = torch.nonzero(score > selection.least_score, as_tuple=True)
        best = best_per_level(score[where, kind], level[where], selection.most_per_level)
        where, kind = where[best], kind[best]
        own = {name: _of_class(flat[name][photo, where], kind, len(canonical_sizes)) for name in _BY_CLASS}
        alone = Camera(camera.intrinsics[photo], camera.width, camera.height)
        projected = location[where] + own["center"]
        rotation, center = place_in_space(own["quaternion"], own["depth"][:, 0], projected, alone)
        score_2d = score[where, kind].sqrt()
        found.append(
            Detections(
                box2d=torch.cat([location[where], location[where]], dim=1)
                + flat["box2d"][photo, where] * _signs(device),
                score_2d=score_2d,
                score_3d=score_2d * own["confidence"][:, 0].sigmoid(),
                kind=kind,
                level=level[where],
                cell=cell[where],
                quaternion=quaternion_from_rotation(rotation),
                projected_center=projected,
                center=center,
                size=(own["size"].tanh() + 1) * canonical_sizes[kind],
            )
        )
    return found


def _locations(rows: int, columns: int, stride: int) -> Float[Tensor, "cells 2"]:
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return torch.stack([x, y], dim=-1).flatten(0, 1).float() * stride


def _signs(device: torch.device) -> Float[Tensor, "4"]:
    """Left and top are subtracted from the location, right and bottom added."""
    return torch.tensor([-1.0, -1.0, 1.0, 1.0], device=device)


def _of_class(
    values: Float[Tensor, "box channels"], kind: Int[Tensor, " box"], num_classes: int
) -> Float[Tensor, "box component"]:
    """What was predicted for the box's own class."""
    by_class = values.unflatten(1, (-1, num_classes))
    return by_class.gather(2, kind[:, None, None].expand(-1, by_class.shape[1], 1))[..., 0]


def best_per_level(score: Float[Tensor, " box"], level: Int[Tensor, " box"], most: int) -> Int[Tensor, " kept"]:
    """Numbers of the `most` best of each level, in ascending order."""
    order = score.argsort(descending=True, stable=True)
    order = order[level[order].argsort(stable=True)]
    counts = torch.bincount(level)
    rank = torch.arange(len(order), device=order.device) - (counts.cumsum(0) - counts)[level[order]]
    return order[rank < most].sort().values


def place_in_space(
    quaternion: Float[Tensor, "box 4"], depth: Float[Tensor, " box"], projected: Float[Tensor, "box 2"], camera: Camera
) -> tuple[Float[Tensor, "box 3 3"], Float[Tensor, "box 3"]]:
    """Rotation (camera from object) and centre (m) of boxes, from what the network says of them without their camera.

    `quaternion` is allocentric, need not be normalised; `depth` is that of the reference camera; `projected` the
    centre's place in the image, px of `camera`.
    """
    ray = camera.unproject(projected, torch.ones_like(depth))
    rotation = egocentric_from_allocentric(ray) @ rotation_from_quaternion(quaternion)
    return rotation, ray * metric_depth(depth, camera)[:, None]


def metric_depth(depth: Float[Tensor, " box"], camera: Camera) -> Float[Tensor, " box"]:
    """Camera z in m: the same object looks as large from further away where pixels are smaller.

    The size of a pixel is that of its diagonal at 1 m, sqrt(1 / fx^2 + 1 / fy^2).
    """
    pixel = (1 / camera.intrinsics[:2]).square().sum().sqrt()
    return (depth * REFERENCE_PIXEL / pixel).clamp(NEAREST_M, FARTHEST_M)


def egocentric_from_allocentric(ray: Float[Tensor, "box 3"]) -> Float[Tensor, "box 3 3"]:
    """The rotation that carries the camera's viewing direction onto each ray and keeps x level."""
    z = torch.nn.functional.normalize(ray, dim=-1)
    down = torch.zeros_like(z)
    down[:, 1] = 1.0
    y = torch.nn.functional.normalize(down - z[:, 1:2] * z, dim=-1)
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
