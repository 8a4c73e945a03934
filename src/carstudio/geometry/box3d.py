"""Oriented 3-D boxes in a camera's frame, and what they cover in its image.

The car frame has its origin at the box centre, x to the front, y down, z to the car's left, metres. A box has a full
rotation; KITTI's yaw is the case of a level camera.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rigid, rotation_y, yaw_from_rotation

# Corner i of the cube [-1, 1]^3: x is the slowest digit, z the fastest; 4..7 are the car's front.
CUBE_CORNERS = tuple((x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0))
# Pairs of corners that differ in exactly one coordinate: the twelve edges of the wireframe.
BOX_EDGES = tuple((i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit)


@dataclass(frozen=True)
class Box3D:
    """Centre (camera frame, metres), size (length, height, width, metres) and rotation `camera_from_car`."""

    center: Float[Tensor, "*batch 3"]
    size: Float[Tensor, "*batch 3"]
    rotation: Float[Tensor, "*batch 3 3"]

    @property
    def yaw_rad(self) -> Float[Tensor, "*batch"]:
        """KITTI's rotation_y, the heading of the car in the camera's x-z plane."""
        return yaw_from_rotation(self.rotation)

    @property
    def camera_from_car(self) -> Float[Tensor, "*batch 4 4"]:
        """Rigid transform from the car frame to the camera frame."""
        return rigid(self.rotation, self.center)

    def corners(self) -> Float[Tensor, "*batch 8 3"]:
        """The eight corners in the camera frame, in the order of `CUBE_CORNERS`."""
        cube = self.center.new_tensor(CUBE_CORNERS)
        return (cube * self.size[..., None, :] / 2) @ self.rotation.mT + self.center[..., None, :]

    def select(self, rows: slice | Tensor) -> "Box3D":
        """Some of the batch entries."""
        return Box3D(self.center[rows], self.size[rows], self.rotation[rows])

    def to(self, device: torch.device | str) -> "Box3D":
        """The same box on another device."""
        return Box3D(self.center.to(device), self.size.to(device), self.rotation.to(device))


def box_from_kitti(
    bottom_center: Float[Tensor, "*batch 3"],
    size: Float[Tensor, "*batch 3"],
    yaw_rad: Float[Tensor, "*batch"],
    camera_offset: Float[Tensor, "*#batch 3"] | None = None,
) -> Box3D:
    """Box of a KITTI label: `bottom_center` is the centre of the BOTTOM face in the label frame.

    The one place where bottom becomes centre (half a height up, y points down). `camera_offset` (metres) carries the
    label frame into the camera frame (`camera_offset_from_projection`); None drops it, as the released code does.
    """
    half_height = torch.zeros_like(size)
    half_height[..., 1] = size[..., 1] / 2
    center = bottom_center - half_height
    if camera_offset is not None:
        center = center + camera_offset
    return Box3D(center, size, rotation_y(yaw_rad))


def mirror_box(box: Box3D) -> Box3D:
    """The box as it stands in the photo mirrored left to right (camera x negated), with a proper rotation.

    Mirroring camera and car (the car is symmetric in z) turns R into M R N with M = diag(-1, 1, 1), N = diag(1, 1, -1).
    """
    mirror_x = box.center.new_tensor([-1.0, 1.0, 1.0])
    mirror_z = box.center.new_tensor([1.0, 1.0, -1.0])
    return Box3D(box.center * mirror_x, box.size, mirror_x[:, None] * box.rotation * mirror_z)


def displaced_box(
    box: Box3D,
    shift: Float[Tensor, "*batch 3"],
    turn_rad: Float[Tensor, "*batch"],
    growth: Float[Tensor, "*batch 3"],
) -> Box3D:
    """The box moved along its axes by shares of its sizes, turned about its vertical axis, its sizes multiplied."""
    center = box.center + (box.rotation @ (shift * box.size)[..., None]).squeeze(-1)
    return Box3D(center, box.size * growth, box.rotation @ rotation_y(turn_rad))


def projected_hull_points(box: Box3D, camera: Camera, near_m: float = 0.1) -> Float[Tensor, "n 2"]:
    """Image positions whose convex hull is the box's outline: its corners, the edges cut at the near plane.

    Of one box (no batch). Empty when the whole box lies behind `near_m`.
    """
    corners = box.corners()
    points = [corners[corners[:, 2] >= near_m]]
    for i, j in BOX_EDGES:
        a, b = corners[i], corners[j]
        if (a[2] - near_m) * (b[2] - near_m) < 0:
            points.append((a + (b - a) * (near_m - a[2]) / (b[2] - a[2]))[None])
    return camera.project(torch.cat(points))


def envelope(box: Box3D, camera: Camera, *, clip: bool = True) -> Float[Tensor, "4"] | None:
    """Smallest 2-D box (x0, y0, x1, y1 px) around the projected 3-D box, clipped to the image by default.

    The paper's "minimum 2D envelope box for reprojecting the 3D box" (filter 1). None when nothing of it is in view.
    """
    points = projected_hull_points(box, camera)
    if len(points) == 0:
        return None
    low, high = points.amin(dim=0), points.amax(dim=0)
    if clip:
        limit = points.new_tensor([camera.width, camera.height])
        low, high = low.clamp(min=0).minimum(limit), high.clamp(min=0).minimum(limit)
        if bool((high - low <= 0).any()):
            return None
    return torch.cat([low, high])
