"""`--box3d dd3d:FOLDER`: from a photo and its camera to 3-D boxes of vehicles in our axes.

The paper finds its 3-D boxes this way (section III-B). KITTI's labels, from which the network has learned, are in the
frame of camera 0, and its boxes are too: the photo's `camera_offset` carries them into the camera.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion, yaw_from_rotation
from carstudio.perception.dd3d.decoding import Detections
from carstudio.perception.dd3d.model import DD3D, KITTI_CLASSES
from carstudio.perception.dd3d.weights import load_dd3d
from carstudio.perception.results import Detection3D, Photo
from carstudio.perception.vehicle_classes import vehicle_type

SHORTEST_PX = 384  # the shorter side as the network sees it, in training and in the released evaluation
LONGEST_PX = 4096  # a photo ten times as wide as high is none that it was made for, and takes gigabytes
UPRIGHT = 1e-4  # rad: a box that leans less is described by its yaw
# Columns: our car's axes (front, down, left) in DD3D's (x front, y left, z up).
DD3D_FROM_CAR = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
Precision = Literal["float32", "bfloat16"]


@dataclass(frozen=True, kw_only=True)
class Dd3dEstimator:
    """3-D boxes of cars, vans and trucks. Holds settings only: each process loads the network once."""

    folder: Path
    device: str = "auto"
    precision: Precision = "float32"
    """bfloat16 takes 0.4 of the time on a CPU that has it; what it does to boxes of trained weights is not known."""

    @torch.inference_mode()
    def estimate(self, photo: Photo) -> list[Detection3D]:
        """All boxes, the surest first, px and metres of the photo."""
        device = pick_device(self.device)
        network = open_dd3d(str(self.folder), str(device), self.precision)
        height, width = photo.image.shape[:2]
        camera = Camera(torch.tensor(photo.intrinsics, dtype=torch.float64), width, height)
        pixels, camera = as_seen(photo.image, camera)
        (found,) = network.detect([pixels.to(device)], [camera])
        return to_photo(found, camera, photo)


def as_seen(image: UInt8[np.ndarray, "height width 3"], camera: Camera) -> tuple[UInt8[Tensor, "3 _ _"], Camera]:
    """The photo as the network wants it: the shorter side of `SHORTEST_PX`, BGR; and the camera of that picture."""
    factor = SHORTEST_PX / min(camera.width, camera.height)
    width, height = int(camera.width * factor + 0.5), int(camera.height * factor + 0.5)
    if max(width, height) > LONGEST_PX:
        raise InputError(
            f"the photo is {camera.width} x {camera.height} px; DD3D takes photos whose longer side is at most "
            f"{LONGEST_PX / SHORTEST_PX:.1f} times the shorter; crop it"
        )
    resized = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))
    bgr = np.ascontiguousarray(resized[..., ::-1].transpose(2, 0, 1))
    return torch.from_numpy(bgr), camera.resize(width, height)


def to_photo(found: Detections, seen: Camera, photo: Photo) -> list[Detection3D]:
    """Vehicles among the detections in the picture of camera `seen`, as boxes of the photo, clipped to it."""
    height, width = photo.image.shape[:2]
    factors = torch.tensor([width / seen.width, height / seen.height] * 2, dtype=torch.float64)
    limit = torch.tensor([width, height] * 2, dtype=torch.float64)
    boxes = (found.box2d.cpu().double() * factors).clamp(min=0.0).minimum(limit)
    rotations = rotation_from_quaternion(found.quaternion.cpu().double()) @ torch.tensor(DD3D_FROM_CAR).double()
    centers = found.center.cpu().double() + torch.tensor(photo.camera_offset, dtype=torch.float64)
    names = list(KITTI_CLASSES)
    results = []
    for i, (kind, size, score) in enumerate(
        zip(found.kind.tolist(), found.size.tolist(), found.score_3d.tolist(), strict=True)
    ):
        x0, y0, x1, y1 = boxes[i].tolist()
        vehicle = vehicle_type(names[kind])
        if vehicle is None or x1 <= x0 or y1 <= y0:
            continue
        yaw, quaternion = upright(rotations[i])
        x, y, z = centers[i].tolist()
        box_width, box_length, box_height = size
        results.append(
            Detection3D(
                box2d=(x0, y0, x1, y1),
                type=vehicle,
                center=(x, y, z),
                size=(box_length, box_height, box_width),
                yaw=yaw,
                rotation=quaternion,
                score=score,
            )
        )
    return results


def upright(rotation: Float[Tensor, "3 3"]) -> tuple[float, tuple[float, float, float, float] | None]:
    """KITTI's yaw of `camera_from_car`, and its quaternion where the box leans."""
    yaw = float(yaw_from_rotation(rotation))
    leaning = math.acos(max(-1.0, min(1.0, float(rotation[1, 1]))))
    if leaning < UPRIGHT:
        return yaw, None
    w, x, y, z = quaternion_from_rotation(rotation).tolist()
    return yaw, (w, x, y, z)


@lru_cache(maxsize=2)
def open_dd3d(folder: str, device: str, precision: Precision) -> DD3D:
    """The network of a converted folder, fused, loaded once per process."""
    return load_dd3d(Path(folder)).fuse().set_precision(getattr(torch, precision)).to(device)
