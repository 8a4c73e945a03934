"""Rigid transforms as 4 x 4 matrices that act on column vectors, and rotations.

A transform is named after what it does: `car_from_camera @ point_camera = point_car`.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_y(yaw_rad: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """KITTI's rotation about the camera's y axis (down): yaw 0 looks along +x, -pi/2 along +z (forward)."""
    c, s = torch.cos(yaw_rad), torch.sin(yaw_rad)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([c, zero, s, zero, one, zero, -s, zero, c], dim=-1).unflatten(-1, (3, 3))


def yaw_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Heading of the x axis in the camera's x-z plane, rad in (-pi, pi]; inverse of `rotation_y` for upright boxes."""
    return torch.atan2(-rotation[..., 2, 0], rotation[..., 0, 0])


def rotation_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z), normalised here."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        dim=-1,
    ).unflatten(-1, (3, 3))  # fmt: skip


def quaternion_from_rotation(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0 of a rotation matrix.

    All four candidate forms are built and the best conditioned one is taken, so that no angle loses precision.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    rows = torch.stack(  # row i is 4 q_i (w, x, y, z)
        [
            torch.stack([1 + xx + yy + zz, wx, wy, wz], dim=-1),
            torch.stack([wx, 1 + xx - yy - zz, xy, xz], dim=-1),
            torch.stack([wy, xy, 1 - xx + yy - zz, yz], dim=-1),
            torch.stack([wz, xz, yz, 1 - xx - yy + zz], dim=-1),
        ],
        dim=-2,
    )
    best = torch.diagonal(rows, dim1=-2, dim2=-1).argmax(dim=-1)
    row = torch.take_along_dim(rows, best[..., None, None], dim=-2).squeeze(-2)
    row = row * torch.where(row[..., :1] < 0, -1.0, 1.0)
    return torch.nn.functional.normalize(row, dim=-1)


def rigid(rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """[R | t] with the last row (0, 0, 0, 1)."""
    upper = torch.cat([rotation, translation[..., None]], dim=-1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=rotation.dtype, device=rotation.device)
    return torch.cat([upper, last.expand(*upper.shape[:-2], 1, 4)], dim=-2)


def invert_rigid(transform: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """[R^T | -R^T t]; only for rotations with translation, not for matrices that scale."""
    rotation = transform[..., :3, :3].mT
    return rigid(rotation, -(rotation @ transform[..., :3, 3:]).squeeze(-1))


def transform_points(
    transform: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3"]:
    """A p + b for n points under one affine transform per batch entry."""
    return points @ transform[..., :3, :3].mT + transform[..., None, :3, 3]


def transform_directions(
    transform: Float[Tensor, "*batch 4 4"], directions: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3"]:
    """A d for n directions: no translation, no normalisation."""
    return directions @ transform[..., :3, :3].mT
