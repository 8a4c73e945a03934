"""Looking at a car from around it: where its box stands in a camera that circles it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y

NUM_TURNS = 19  # of a car turned all around in steps of 360 / 19 degrees: the figure of the paper's comparison with NSG


def orbit_box(size: Float[Tensor, "3"], *, azimuth_deg: float, elevation_deg: float, distance_m: float) -> Box3D:
    """The car's box in a camera that looks at its centre from `distance_m`, upright in the image.

    Azimuth 0 looks at the front, 90 at the car's left side, 180 at the rear; elevation is the camera's height angle.
    """
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    toward_camera = size.new_tensor(
        [math.cos(elevation) * math.cos(azimuth), -math.sin(elevation), math.cos(elevation) * math.sin(azimuth)]
    )
    forward = -toward_camera
    right = size.new_tensor([-math.sin(azimuth), 0.0, math.cos(azimuth)])  # level; defined also straight from above
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return Box3D(size.new_tensor([0.0, 0.0, distance_m]), size, rotation)


def orbit_camera(size_px: int, field_of_view_deg: float = 30.0) -> Camera:
    """A square camera for `orbit_box`."""
    focal_px = size_px / 2 / math.tan(math.radians(field_of_view_deg) / 2)
    return Camera(torch.tensor([focal_px, focal_px, size_px / 2, size_px / 2]), size_px, size_px)


def orbit_distance(size: Float[Tensor, "3"], field_of_view_deg: float = 30.0, fill: float = 0.95) -> float:
    """Distance at which the car's bounding sphere fills the given share of the image's width."""
    return float(size.norm()) / 2 / (fill * math.sin(math.radians(field_of_view_deg) / 2))


def viewing_angles(box: Box3D) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """(azimuth in (-pi, pi], elevation in [-pi/2, pi/2]), rad, from which a camera sees a box: `orbit_box` reversed.

    The camera's place in the car frame counts, not the heading in the picture: 0 is before the car's front, pi/2 at its
    left side; elevation is positive where the camera is higher than the box's centre.
    """
    x, y, z = (-(box.center[..., None, :] @ box.rotation)[..., 0, :]).unbind(-1)
    return torch.atan2(z, x), torch.atan2(-y, torch.hypot(x, z))


def turned_box(box: Box3D, angle_rad: float) -> Box3D:
    """The car turned to its left where it stands, about its vertical axis."""
    turn = rotation_y(torch.tensor(angle_rad, dtype=box.rotation.dtype, device=box.rotation.device))
    return Box3D(box.center, box.size, box.rotation @ turn)
