"""What a patch tells without a network: the car's pose in the camera, and a tiny copy of its pixels."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.models.interface import PatchBatch

POSE_FEATURES = 12


def pose_features(patches: PatchBatch) -> Float[Tensor, "batch 12"]:
    """The camera's viewing direction and axes in the car frame (9 numbers) and log size over a usual car's (3)."""
    toward = nn.functional.normalize(patches.box.center, dim=-1)
    right = nn.functional.normalize(torch.linalg.cross(toward.new_tensor([0.0, 1.0, 0.0]).expand_as(toward), toward))
    down = torch.linalg.cross(toward, right)
    axes_in_car = patches.box.rotation.mT @ torch.stack([toward, right, down], dim=-1)
    usual = patches.box.size.new_tensor([4.2, 1.55, 1.8])
    return torch.cat([axes_in_car.flatten(-2), torch.log(patches.box.size / usual)], dim=-1)


def tiny_masked_copy(patches: PatchBatch, side_px: int) -> Float[Tensor, "batch feature"]:
    """Mean colour of the car's pixels in each cell of a side_px x side_px grid, 0 where a cell has none."""
    mask = patches.mask[:, None]
    colour = nn.functional.adaptive_avg_pool2d(patches.image * mask, side_px)
    cover = nn.functional.adaptive_avg_pool2d(mask, side_px)
    return (colour / cover.clamp(min=1e-3) * (cover > 0.05)).flatten(1)
