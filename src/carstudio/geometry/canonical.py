"""The car-centric canonical frame (Car-Studio Eq. 1-2): the box scaled to [-1, 1]^3, x front, y down, z the car's left.

`canonical_from_camera = S R^T [I | -t]` with S = diag(2/length, 2/height, 2/width). Our camera is OpenCV's; the paper's
factor diag(1, -1, -1, 1) is the change from the OpenGL camera and stands in `opencv_from_opengl`.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.transforms import invert_rigid

PARALLEL = 1e-10  # canonical units per metre: a ray of a kilometre drifts by 1e-7, less than a float resolves


def canonical_from_car(size: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4 4"]:
    """Car-Studio Eq. 1: diag(2/length, 2/height, 2/width, 1)."""
    return torch.diag_embed(torch.cat([2 / size, torch.ones_like(size[..., :1])], dim=-1))


def canonical_from_camera(box: Box3D) -> Float[Tensor, "*batch 4 4"]:
    """Car-Studio Eq. 2 for an OpenCV camera: affine, metres to canonical units."""
    return canonical_from_car(box.size) @ invert_rigid(box.camera_from_car)


def opencv_from_opengl(like: Tensor) -> Float[Tensor, "4 4"]:
    """diag(1, -1, -1, 1), the paper's last factor of Eq. 2 (it is its own inverse)."""
    return torch.diag(like.new_tensor([1.0, -1.0, -1.0, 1.0]))


def ray_cube_interval(
    origins: Float[Tensor, "*ray 3"], directions: Float[Tensor, "*ray 3"]
) -> tuple[Float[Tensor, "*ray"], Float[Tensor, "*ray"], Bool[Tensor, "*ray"]]:
    """Entry and exit parameter of rays o + t d with the cube [-1, 1]^3, and whether there is an interval of t > 0.

    Directions need not be unit vectors: pass canonical images of metric rays and t stays metric. A camera inside the
    cube enters at t = 0. Where there is no interval both ends are 0. Rays that lie exactly in a face count as inside.
    """
    is_parallel = directions.abs() < PARALLEL
    inverse = 1.0 / torch.where(is_parallel, torch.ones_like(directions), directions)
    t_a, t_b = (-1.0 - origins) * inverse, (1.0 - origins) * inverse
    # Parallel to a pair of faces: between them (or in one) all the way, or never. Kept apart, since 0 * (1 / 0) is NaN.
    always = torch.where(origins.abs() <= 1, torch.inf, -torch.inf)
    entry = torch.where(is_parallel, -always, torch.minimum(t_a, t_b)).amax(dim=-1).clamp(min=0.0)
    exit_ = torch.where(is_parallel, always, torch.maximum(t_a, t_b)).amin(dim=-1)
    hit = exit_ > entry
    zero = torch.zeros_like(entry)
    return torch.where(hit, entry, zero), torch.where(hit, exit_, zero), hit
