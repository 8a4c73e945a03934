"""What the input photo shows at points of the car: its colour there, and whether the point is seen at all."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.models.interface import PatchBatch

PHOTO_FEATURES = 4  # rgb times visibility, visibility
DEPTH_CELLS = 20  # side of the coarse depth buffer
MARGIN = 0.06  # share of the car's length behind the nearest point of a cell at which half of it counts as seen


def photo_at(points: Float[Tensor, "batch point 3"], patches: PatchBatch) -> Float[Tensor, "batch point 4"]:
    """Colour of the masked photo at canonical points (premultiplied by visibility), and their visibility.

    A point is seen where the mask is car and no other point of its cell in a coarse depth buffer is much nearer.
    """
    box = patches.box
    in_camera = (points * box.size[:, None] / 2) @ box.rotation.mT + box.center[:, None]
    pixel = patches.camera.project(in_camera)
    side = patches.image.shape[-1]
    masked = torch.cat([patches.image * patches.mask[:, None], patches.mask[:, None]], dim=1)
    grid = (pixel / side * 2 - 1).clamp(-4, 4)[:, None]
    found = nn.functional.grid_sample(masked, grid, mode="bilinear", align_corners=False)[:, :, 0].mT
    seen = in_front(pixel / side, in_camera.norm(dim=-1), MARGIN * box.size[:, :1]) * found[..., 3]
    return torch.cat([found[..., :3] / found[..., 3:].clamp(min=1e-3) * seen[..., None], seen[..., None]], dim=-1)


def in_front(
    position: Float[Tensor, "batch point 2"], distance: Float[Tensor, "batch point"], margin: Float[Tensor, "batch 1"]
) -> Float[Tensor, "batch point"]:
    """How likely nothing hides a point (1 to 0), from the nearest point of its cell in a coarse depth buffer."""
    column, row = (position * DEPTH_CELLS).long().clamp(0, DEPTH_CELLS - 1).unbind(-1)
    cell = row * DEPTH_CELLS + column
    nearest = torch.full((len(cell), DEPTH_CELLS**2), torch.inf, dtype=distance.dtype, device=distance.device)
    nearest = nearest.scatter_reduce(-1, cell, distance, "amin")
    behind = distance - torch.gather(nearest, -1, cell)
    return torch.sigmoid((margin - behind) / (margin / 4))
