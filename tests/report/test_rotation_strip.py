"""The strip turns the car, not the camera, to its left, and comes back where it began."""

import math

import numpy as np
import torch

import carstudio
from carstudio.geometry.box3d import box_from_kitti
from carstudio.geometry.camera import Camera
from carstudio.models.interface import Latents, render_image
from carstudio.report.rotation_strip import rotation_strip


def test_a_strip_is_the_car_at_other_yaws() -> None:
    model = carstudio.load_model("car-gaussians")
    latents = Latents(torch.zeros(1, 128), torch.zeros(1, 128))
    camera = Camera(torch.tensor([90.0, 90.0, 32.0, 24.0]), 64, 48)

    def box(yaw: float):
        bottom, size = torch.tensor([[0.2, 1.2, 8.0]]), torch.tensor([[4.2, 1.5, 1.8]])
        return box_from_kitti(bottom, size, torch.tensor([yaw]))

    strip = rotation_strip(model, latents, box(0.4), camera, steps=5, background=0.0)
    assert len(strip) == 5
    for turn, picture in enumerate(strip):
        with torch.no_grad():
            there = render_image(model, camera, latents, box(0.4 + 2 * math.pi * turn / 5))["rgb"].numpy()
        assert np.abs(picture / 255 - there).max() < 1 / 255 + 1e-3, turn
    assert np.abs(strip[0].astype(int) - strip[1]).max() > 40
