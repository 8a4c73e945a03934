"""A photo of a car laid out on the faces of its box: what a network sees of a car then hardly depends on the camera.

Faces are drawn from the photo through the known camera and box, as if the car's skin lay in them. It does not quite, so
what stands back from a face is shifted, but wheels, windows and lamps of all cars come to lie near the same places.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.geometry.canonical import canonical_from_camera
from carstudio.models.interface import PatchBatch

CHANNELS = 5  # r, g, b, car, seen
PLANE = 0.9  # canonical distance of the planes from the middle: a body's sides and ends lie a little inside the box
_NEAR_M = 0.1


def box_faces(patches: PatchBatch, side_px: int) -> Float[Tensor, "batch 5 side side"]:
    """Photos resampled on planes near the faces of their boxes; `side_px` is even.

    Upper half: the side that the camera is on, front to the right; a left side is as seen from within, so that both
    sides look alike. Lower half: front and rear, the visible side of the car at the right; at most one of them is seen.
    Rows run down the box. Channels: rgb in [-1, 1], share of the car, and 1 where the photo shows the place; all are 0
    where the photo does not reach or the camera is behind the plane.
    """
    eye = canonical_from_camera(patches.box)[:, :3, 3]
    near_side = torch.where(eye[:, 2] >= 0, 1.0, -1.0).to(eye)
    points, outward = _planes(side_px, eye)
    turned = torch.stack([torch.ones_like(near_side), torch.ones_like(near_side), near_side], dim=-1)[:, None]
    in_camera = (points * turned * (patches.box.size / 2)[:, None]) @ patches.box.rotation.mT
    in_camera = in_camera + patches.box.center[:, None]
    is_before = ((eye[:, None] * turned * outward).sum(dim=-1) > PLANE) & (in_camera[..., 2] > _NEAR_M)
    in_camera = torch.cat([in_camera[..., :2], in_camera[..., 2:].clamp(min=_NEAR_M)], dim=-1)
    size = eye.new_tensor([patches.camera.width, patches.camera.height])
    place = 2 * patches.camera.project(in_camera) / size - 1
    place = torch.where(is_before[..., None], place, -9.0).clamp(-9, 9)  # far outside: sampled as 0
    mask = patches.mask[:, None]
    pixels = torch.cat([2 * patches.image - 1, mask, torch.ones_like(mask)], dim=1)
    found = nn.functional.grid_sample(pixels.to(place), place[:, :, None], padding_mode="zeros", align_corners=False)
    half = side_px // 2
    side, front, rear = found.squeeze(-1).split([half * side_px, half * half, half * half], dim=-1)
    ends = torch.cat([front.unflatten(-1, (half, half)), rear.unflatten(-1, (half, half))], dim=-1)
    return torch.cat([side.unflatten(-1, (half, side_px)), ends], dim=-2)


def _planes(side_px: int, like: Tensor) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
    """Canonical points of the three planes' pixels, row by row, and which way each plane faces: left, front, rear."""
    half = side_px // 2
    along, down = (_centres(count, like) for count in (side_px, half))
    y, x = torch.meshgrid(down, along, indexing="ij")
    left = torch.stack([x, y, torch.full_like(x, PLANE)], dim=-1).flatten(0, 1)
    y, z = torch.meshgrid(down, down, indexing="ij")
    front = torch.stack([torch.full_like(z, PLANE), y, z], dim=-1).flatten(0, 1)
    rear = front * front.new_tensor([-1.0, 1.0, 1.0])
    facing = [[0.0, 0.0, 1.0]] * len(left) + [[1.0, 0.0, 0.0]] * len(front) + [[-1.0, 0.0, 0.0]] * len(rear)
    return torch.cat([left, front, rear]), like.new_tensor(facing)


def _centres(count: int, like: Tensor) -> Float[Tensor, " count"]:
    """Middles of `count` equal parts of [-1, 1]."""
    return (2 * torch.arange(count, device=like.device, dtype=like.dtype) + 1) / count - 1
