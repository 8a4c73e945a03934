"""Patches made ready for training and scoring: decoded once, resized for the encoder, kept in a bounded cache."""

from collections import OrderedDict
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from carstudio.dataset.patch import MaskValue, Patch
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D, mirror_box
from carstudio.geometry.camera import Camera


@dataclass(frozen=True)
class PreparedPatch:
    """One patch with a 3-D box. `rgb` and `mask` (values of `MaskValue`) are the crop at its own resolution."""

    patch_id: str
    instance_id: str
    rgb: UInt8[Tensor, "height width 3"]
    mask: UInt8[Tensor, "height width"]
    camera: Camera
    box: Box3D
    encoder_image: UInt8[Tensor, "3 side side"]
    encoder_mask: UInt8[Tensor, "side side"]  # share of the car in a pixel, 0-255
    encoder_camera: Camera

    @property
    def num_bytes(self) -> int:
        """Memory held by the pixels."""
        return self.rgb.numel() + self.mask.numel() + self.encoder_image.numel() + self.encoder_mask.numel()


def prepare_patch(patch: Patch, side_px: int) -> PreparedPatch:
    """Resize the whole crop to a square (area average when shrinking, as released: aspect is not kept)."""
    if patch.box is None:
        raise InputError(f"patch {patch.patch_id} has no 3-D box; training and scoring need one")
    size = (side_px, side_px)
    shrinks = patch.image.shape[0] > side_px or patch.image.shape[1] > side_px
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    is_car = np.where(patch.mask == MaskValue.CAR, 255, 0).astype(np.uint8)
    image = cv2.resize(patch.image, size, interpolation=how)
    return PreparedPatch(
        patch_id=patch.patch_id,
        instance_id=patch.instance_id,
        rgb=torch.from_numpy(patch.image),
        mask=torch.from_numpy(patch.mask),
        camera=patch.camera,
        box=patch.box,
        encoder_image=torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))),
        encoder_mask=torch.from_numpy(cv2.resize(is_car, size, interpolation=how)),
        encoder_camera=patch.camera.resize(*size),
    )


def mirror_patch(patch: PreparedPatch) -> PreparedPatch:
    """The photo flipped left to right with mirrored camera and box: another view of the same (symmetric) car."""
    return replace(
        patch,
        rgb=patch.rgb.flip(1),
        mask=patch.mask.flip(1),
        camera=patch.camera.flip(),
        box=mirror_box(patch.box),
        encoder_image=patch.encoder_image.flip(2),
        encoder_mask=patch.encoder_mask.flip(1),
        encoder_camera=patch.encoder_camera.flip(),
    )


class PatchCache:
    """Prepared patches of a store, read on demand; the least recently used go when `max_bytes` is reached."""

    def __init__(self, store: PatchStore, side_px: int, max_bytes: int = 2 * 2**30) -> None:
        self.store = store
        self.side_px = side_px
        self.max_bytes = max_bytes
        self._patches: OrderedDict[str, PreparedPatch] = OrderedDict()
        self._bytes = 0

    def __getitem__(self, patch_id: str) -> PreparedPatch:
        if patch_id in self._patches:
            self._patches.move_to_end(patch_id)
            return self._patches[patch_id]
        prepared = prepare_patch(self.store.patch(patch_id), self.side_px)
        self._patches[patch_id] = prepared
        self._bytes += prepared.num_bytes
        while self._bytes > self.max_bytes and len(self._patches) > 1:
            _, oldest = self._patches.popitem(last=False)
            self._bytes -= oldest.num_bytes
        return prepared
