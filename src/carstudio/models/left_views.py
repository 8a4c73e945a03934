"""Every photo as a view of a car's left side: cars are symmetric, so a right side is a left one in a mirror."""

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D, mirror_box
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera
from carstudio.models.interface import PatchBatch


def as_left_views(patches: PatchBatch) -> tuple[PatchBatch, Float[Tensor, " batch"]]:
    """Patches of which those whose camera is on the car's right (canonical z < 0) are flipped left to right, with
    mirrored camera and box; and the side that each camera is on, 1 left and -1 right.

    Whatever is made of the patches alone is the same for a photo and its mirror image.
    """
    eye = canonical_from_camera(patches.box)[:, :3, 3]
    is_right = eye[:, 2] < 0
    camera, box = patches.camera.flip(), mirror_box(patches.box)

    def choose(flipped: Tensor, own: Tensor) -> Tensor:
        return torch.where(is_right.view(-1, *[1] * (own.ndim - 1)), flipped, own)

    turned = PatchBatch(
        image=choose(patches.image.flip(3), patches.image),
        mask=choose(patches.mask.flip(2), patches.mask),
        camera=Camera(choose(camera.intrinsics, patches.camera.intrinsics), camera.width, camera.height),
        box=Box3D(choose(box.center, patches.box.center), box.size, choose(box.rotation, patches.box.rotation)),
        instance_ids=patches.instance_ids,
    )
    return turned, torch.where(is_right, -1.0, 1.0).to(patches.image)
