"""A photo of a car laid out on the faces of its box: what a network sees of a car then hardly depends on the camera.

Faces are drawn from the photo through the known camera and box, as if the car's skin lay in them. It does not quite, so
what stands back from a face is shifted, but wheels, windows and lamps of all cars come to lie near the same places.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.geometry.camera import Camera
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
    one = torch.ones_like(near_side)
    to_camera = patches.box.rotation * (patches.box.size / 2 * torch.stack([one, one, near_side], dim=-1))[:, None]
    to_image = _to_image(patches.camera)
    seen_at = _planes(side_px, eye) @ (to_image @ to_camera).mT + (to_image @ patches.box.center[..., None]).mT
    half = side_px // 2
    counts = [half * side_px, half * half, half * half]
    before = torch.stack([eye[:, 2] * near_side, eye[:, 0], -eye[:, 0]], dim=-1) > PLANE
    seen = before.repeat_interleave(torch.tensor(counts, device=eye.device), dim=1) & (seen_at[..., 2] > _NEAR_M)
    place = (seen_at[..., :2] / seen_at[..., 2:].clamp(min=_NEAR_M)).clamp(-9, 9)
    place = place.masked_fill(~seen[..., None], -9.0)  # far outside: sampled as 0
    mask = patches.mask[:, None]
    pixels = torch.cat([2 * patches.image - 1, mask, torch.ones_like(mask)], dim=1)
    found = nn.functional.grid_sample(pixels.to(place), place[:, :, None], padding_mode="zeros", align_corners=False)
    side, front, rear = found.squeeze(-1).split(counts, dim=-1)
    ends = torch.cat([front.unflatten(-1, (half, half)), rear.unflatten(-1, (half, half))], dim=-1)
    return torch.cat([side.unflatten(-1, (half, side_px)), ends], dim=-2)


def _to_image(camera: Camera) -> Float[Tensor, "batch 3 3"]:
    """Camera points to homogeneous places in the photo, whose sides are at -1 and 1."""
    fx, fy, cx, cy = camera.intrinsics.unbind(-1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    across = torch.stack([2 * fx / camera.width, zero, 2 * cx / camera.width - 1], dim=-1)
    down = torch.stack([zero, 2 * fy / camera.height, 2 * cy / camera.height - 1], dim=-1)
    return torch.stack([across, down, torch.stack([zero, zero, one], dim=-1)], dim=-2)


def _planes(side_px: int, like: Tensor) -> Float[Tensor, "pixel 3"]:
    """Canonical points of the three planes' pixels, row by row: left side, front, rear."""
    half = side_px // 2
    along, down = (_centres(count, like) for count in (side_px, half))
    y, x = torch.meshgrid(down, along, indexing="ij")
    left = torch.stack([x, y, torch.full_like(x, PLANE)], dim=-1).flatten(0, 1)
    y, z = torch.meshgrid(down, down, indexing="ij")
    front = torch.stack([torch.full_like(z, PLANE), y, z], dim=-1).flatten(0, 1)
    return torch.cat([left, front, front * front.new_tensor([-1.0, 1.0, 1.0])])


def _centres(count: int, like: Tensor) -> Float[Tensor, " count"]:
    """Middles of `count` equal parts of [-1, 1]."""
    return (2 * torch.arange(count, device=like.device, dtype=like.dtype) + 1) / count - 1
