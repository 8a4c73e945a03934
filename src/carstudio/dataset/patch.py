"""A CarPatch3D patch: one crop of one photograph with its camera, 3-D box, mask and measured scores.

`PatchRecord` is the row as stored (images as encoded bytes; columns as documented in docs/dataset_format.md); `Patch`
is the row decoded, with the camera of the crop. Patch pixel (u, v) is frame pixel (crop_x0 + u, crop_y0 + v).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Float, UInt8

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_from_quaternion, rotation_y
from carstudio.images import decode_depth, decode_image


class MaskValue(IntEnum):
    """The three values of a mask pixel. Unknown pixels take part in no loss and no metric."""

    BACKGROUND = 0
    UNKNOWN = 128  # another object in front, padding, outside the photo
    CAR = 255


@dataclass(frozen=True, kw_only=True)
class PatchRecord:
    """One row of `data/`: what a source and the perception measured, before anyone judged it. None is "unknown"."""

    patch_id: str
    instance_id: str  # a physical car; the patch itself where identity across images is unknown
    frame_id: str
    sequence_id: str | None = None
    frame_index: int | None = None
    source: str
    image: bytes  # PNG or JPEG of the crop
    mask: bytes | None = None  # PNG with the values of `MaskValue`, same size
    depth: bytes | None = None  # 16-bit PNG, metres * 256, same size
    frame_path: str
    frame_width: int | None  # px; None where the source does not tell the photograph's size
    frame_height: int | None
    crop_x0: int
    crop_y0: int
    crop_width: int
    crop_height: int
    fx: float  # intrinsics of the full frame, px, pixel centres at +0.5
    fy: float
    cx: float
    cy: float
    camera_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m; X_camera = X_label_frame + camera_offset
    camera_source: str
    box2d: tuple[float, float, float, float]  # x0, y0, x1, y1 px in the frame
    box_center: tuple[float, float, float] | None = None  # m, OpenCV camera, offset applied; None: no 3-D box
    box_size: tuple[float, float, float] | None = None  # length, height, width, m
    box_yaw: float | None = None  # rad, KITTI rotation_y
    box_rotation: tuple[float, float, float, float] | None = None  # quaternion w, x, y, z where not upright
    score_2d: float | None = None
    score_mask: float | None = None
    score_3d: float | None = None
    mask_ratio: float | None = None  # car pixels / area of the 2-D box
    box_iou: float | None = None  # 2-D box against the envelope of the projected 3-D box
    truncation: float | None = None
    occlusion: int | None = None
    licence: str
    sha256: str  # of the image bytes
    extra: str = "{}"  # JSON of the source's own record, verbatim

    @property
    def frame_camera(self) -> Camera:
        """Camera of the full frame, float32; a frame of unknown size ends where the crop does."""
        width = self.crop_x0 + self.crop_width if self.frame_width is None else self.frame_width
        height = self.crop_y0 + self.crop_height if self.frame_height is None else self.frame_height
        return Camera(torch.tensor([self.fx, self.fy, self.cx, self.cy]), width, height)

    @property
    def box(self) -> Box3D | None:
        """The 3-D box in the camera frame, float32; None when the patch has none."""
        if self.box_center is None or self.box_size is None:
            return None
        if self.box_rotation is not None:
            rotation = rotation_from_quaternion(torch.tensor(self.box_rotation, dtype=torch.float64)).float()
        else:
            assert self.box_yaw is not None
            rotation = rotation_y(torch.tensor(self.box_yaw, dtype=torch.float64)).float()
        return Box3D(torch.tensor(self.box_center), torch.tensor(self.box_size), rotation)

    def decode(self) -> "Patch":
        """Pixels, mask, camera of the crop and box."""
        image = decode_image(self.image, name=f"image of patch {self.patch_id}")
        if self.mask is None:
            mask = np.full(image.shape[:2], MaskValue.UNKNOWN, np.uint8)
        else:
            mask = decode_image(self.mask, name=f"mask of patch {self.patch_id}", mode="L")
        depth = None if self.depth is None else decode_depth(self.depth, name=f"depth of patch {self.patch_id}")
        camera = self.frame_camera.crop(self.crop_x0, self.crop_y0, self.crop_width, self.crop_height)
        return Patch(self.patch_id, self.instance_id, image, mask, depth, camera, self.box)


@dataclass(frozen=True)
class Patch:
    """A decoded patch. `camera` is the camera of the crop; `depth_m` is camera z, NaN where there is none."""

    patch_id: str
    instance_id: str
    image: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"]
    depth_m: Float[np.ndarray, "height width"] | None
    camera: Camera
    box: Box3D | None
