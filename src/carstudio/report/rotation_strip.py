"""A car turned where it stands, in equal steps: the strips of the paper's comparison with NSG."""

import math

import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.images import to_uint8
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.report.sheets import Pixels

STEPS = 19  # the paper's figure: 360 / 19 degrees each


@torch.no_grad()
def rotation_strip(
    model: CategoryModel,
    latents: Latents,
    box: Box3D,
    camera: Camera,
    *,
    steps: int = STEPS,
    background: float = 1.0,
) -> list[Pixels]:
    """The car (batches of one) in one camera after 0, 1, ... turns of 360 / `steps` degrees about its vertical axis."""
    device = latents.shape.device
    pictures = []
    for turn in range(steps):
        angle = torch.tensor(2 * math.pi * turn / steps, dtype=box.rotation.dtype)
        turned = Box3D(box.center, box.size, box.rotation @ rotation_y(angle).to(box.rotation.device))
        image = render_image(model, camera.to(device), latents, turned.to(device))
        rgb = image["rgb"] + (1 - image["opacity"][..., None]) * background
        pictures.append(to_uint8(rgb.cpu().numpy()))
    return pictures
