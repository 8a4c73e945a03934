"""A car's own rendering in place of a photograph: where none shows it, or none shows that side."""

import torch

from carstudio.dataset.patch import MaskValue, Patch
from carstudio.fitting.car_file import Car
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.training.batches import stack_boxes

_SOLID = 0.5  # opacity from which a pixel is on the car


def own_picture(
    model: CategoryModel, car: Car, *, azimuth_deg: float, elevation_deg: float = 8.0, side_px: int = 128
) -> Patch:
    """The car rendered from one side (0: before its front, 90: at its left) as if it were a photograph on black."""
    device = next(model.parameters()).device
    size = torch.tensor(car.size)
    box = orbit_box(size, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, distance_m=orbit_distance(size))
    camera = orbit_camera(side_px)
    latents = Latents(car.latents.shape.to(device), car.latents.texture.to(device))
    found = render_image(model, camera.to(device), latents, stack_boxes([box]).to(device))
    rgb = (found["rgb"].cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    mask = torch.where(found["opacity"].cpu() > _SOLID, int(MaskValue.CAR), int(MaskValue.BACKGROUND))
    return Patch(car.instance_id, car.instance_id, rgb, mask.to(torch.uint8).numpy(), None, camera, box)
