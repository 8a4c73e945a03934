"""A car turned where it stands, in equal steps: the strips of the paper's comparison with NSG, and the truth to them.

A strip is drawn at the size at which it is shown, in a window that the car stays in all the way around.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PreparedPatch
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import NUM_TURNS, turned_box
from carstudio.images import to_uint8
from carstudio.models.interface import NEAR_M, CategoryModel, Latents, render_image
from carstudio.report.sheets import Pixels

MARGIN = 1.06  # of the window around the car's outline
FINER = 4  # photographs are looked up at so many points across a pixel of the strip
SAME_PLACE_M, SAME_TURN = 0.01, 1e-3  # how near a photographed box comes to a turned one


def turns(box: Box3D, steps: int = NUM_TURNS) -> list[Box3D]:
    """The box after 0, 1, ... turns of 360 / `steps` degrees to the car's left."""
    return [turned_box(box, 2 * math.pi * turn / steps) for turn in range(steps)]


def strip_camera(box: Box3D, camera: Camera, width: int, height: int) -> Camera:
    """The same camera's window of `width` x `height` px in which a car (one box) stays all around.

    `camera` itself, scaled, where the car's box reaches behind it on the way.
    """
    corners = torch.cat([turned.corners() for turned in turns(box)])
    if bool((corners[:, 2] < NEAR_M).any()):
        return camera.resize(width, height)
    points = camera.project(corners)
    low, high = points.amin(dim=0), points.amax(dim=0)
    across = MARGIN * (high - low)
    scale = min(width / float(across[0]), height / float(across[1]))
    size, middle = torch.tensor([width, height]), (low + high) / 2
    fx, fy, cx, cy = (scale * camera.intrinsics).tolist()
    shift_x, shift_y = (size / 2 - scale * middle).tolist()
    return Camera(torch.tensor([fx, fy, cx + shift_x, cy + shift_y]), width, height)


@torch.no_grad()
def rotation_strip(
    model: CategoryModel,
    latents: Latents,
    box: Box3D,
    camera: Camera,
    *,
    steps: int = NUM_TURNS,
    background: float = 1.0,
) -> list[Pixels]:
    """The car (batches of one) in one camera after 0, 1, ... turns of 360 / `steps` degrees about its vertical axis."""
    device = latents.shape.device
    pictures = []
    for turned in turns(box, steps):
        image = render_image(model, camera.to(device), latents, turned.to(device))
        rgb = image["rgb"] + (1 - image["opacity"][..., None]) * background
        pictures.append(to_uint8(rgb.cpu().numpy()))
    return pictures


def true_views(patches: Sequence[PreparedPatch], box: Box3D, steps: int = NUM_TURNS) -> list[PreparedPatch | None]:
    """For each turn of a car (one box) a photograph of it as it stands then, where there is one."""
    return [next((patch for patch in patches if _is_at(patch.box, turned)), None) for turned in turns(box, steps)]


def _is_at(box: Box3D, other: Box3D) -> bool:
    moved = float((box.center - other.center).norm())
    return moved < SAME_PLACE_M and bool(((box.rotation - other.rotation).abs() < SAME_TURN).all())


def seen_by(patch: PreparedPatch, camera: Camera, *, background: float = 1.0) -> Pixels:
    """The car of a photograph, cut out, as another window of the same camera shows it."""
    finer = camera.resize(camera.width * FINER, camera.height * FINER)
    fx, fy, cx, cy = patch.camera.intrinsics.tolist()
    to_fx, to_fy, to_cx, to_cy = finer.intrinsics.tolist()
    sx, sy = to_fx / fx, to_fy / fy
    move_x, move_y = to_cx - sx * cx, to_cy - sy * cy
    # OpenCV counts from the middle of the first pixel
    affine = np.array([[sx, 0, move_x + sx / 2 - 0.5], [0, sy, move_y + sy / 2 - 0.5]])
    is_car = (patch.mask == MaskValue.CAR).numpy()[..., None].astype(np.float32)
    cut_out = np.concatenate([patch.rgb.numpy() / 255 * is_car, is_car], axis=-1).astype(np.float32)
    moved = cv2.warpAffine(cut_out, affine, (finer.width, finer.height))
    small = cv2.resize(moved, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return to_uint8(small[..., :3] + (1 - small[..., 3:]) * background)
