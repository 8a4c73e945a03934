"""A store of four toy cars made on the spot: textured ellipsoids with exact truth, so that training tests need no data.

Each car is an ellipsoid inscribed in its box; its front half is one colour, its rear half another. The pictures come
from closed-form ray-ellipsoid intersection, independent of the volume renderer.
"""

from pathlib import Path

import numpy as np
import torch

from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, StoreWriter, open_store
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.geometry.transforms import quaternion_from_rotation
from carstudio.images import encode_png
from carstudio.models.car_nerf import CarNeRFConfig
from carstudio.models.encoders import EncoderConfig
from carstudio.rendering.field import SamplingConfig
from carstudio.rendering.rays import image_rays
from carstudio.training.config import TrainConfig
from carstudio.training.losses import LossConfig
from carstudio.training.schedule import ScheduleConfig

COLOURS = [((220, 40, 40), (40, 40, 220)), ((230, 200, 40), (40, 180, 60)), ((240, 240, 240), (60, 60, 60))]
SIDE_PX = 40
TINY = TrainConfig(
    recipe="tiny",
    model=CarNeRFConfig(
        encoder=EncoderConfig(kind="small", side_px=32, pretrained=None, num_features=32, sees_mask=True),
        sampling=SamplingConfig(coarse=16, fine=0),
        width=32,
        depth=3,
        skip_after=None,
        code_size=16,
        position_frequencies=4,
        direction_frequencies=1,
        normalise_codes=True,
        colour_skip_px=4,
    ),
    loss=LossConfig(colour="whole-crop"),
    schedule=ScheduleConfig(first=1e-2, last=1e-3, decay_steps=None),
    supervision="mixed",
    patches_per_step=6,
    rays_per_patch=64,
    steps=12,
    split=None,
    log_every=2,
    save_every=4,
)


def toy_record(car: int, view: int, azimuth_deg: float) -> PatchRecord:
    size = torch.tensor([4.0 + 0.2 * car, 1.5, 1.8])
    box = orbit_box(size, azimuth_deg=azimuth_deg, elevation_deg=10.0 + 5.0 * view, distance_m=9.0)
    camera = orbit_camera(SIDE_PX)
    directions = image_rays(camera).directions[0]
    o = (-box.center @ box.rotation) * (2 / size)
    d = (directions @ box.rotation) * (2 / size)
    a, b, c = (d * d).sum(-1), d @ o, (o @ o) - 1
    root = b * b - a * c
    t = (-b - root.clamp(min=0).sqrt()) / a
    hit = (root > 0).reshape(SIDE_PX, SIDE_PX).numpy()
    is_front = ((o + t[:, None] * d)[:, 0] > 0).reshape(SIDE_PX, SIDE_PX, 1).numpy()
    front, rear = (np.array(colour, np.uint8) for colour in COLOURS[car % 3])
    image = np.where(hit[..., None], np.where(is_front, front, rear), 128).astype(np.uint8)
    mask = np.where(hit, MaskValue.CAR, MaskValue.BACKGROUND).astype(np.uint8)
    png = encode_png(image)
    fx, fy, cx, cy = camera.intrinsics.tolist()
    center, length = tuple(box.center.tolist()), tuple(size.tolist())
    return PatchRecord(
        patch_id=f"toy-{car}-{view}",
        instance_id=f"toy-{car}",
        frame_id=f"toy-{car}-{view}",
        sequence_id=f"toy-{car}",
        frame_index=view,
        source="toy",
        image=png,
        mask=encode_png(mask),
        frame_path="toy",
        frame_width=SIDE_PX,
        frame_height=SIDE_PX,
        crop_x0=0,
        crop_y0=0,
        crop_width=SIDE_PX,
        crop_height=SIDE_PX,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        camera_source="exact",
        box2d=(0.0, 0.0, float(SIDE_PX), float(SIDE_PX)),
        box_center=(center[0], center[1], center[2]),
        box_size=(length[0], length[1], length[2]),
        box_yaw=float(box.yaw_rad),
        box_rotation=tuple(quaternion_from_rotation(box.rotation).tolist()),
        licence="CC0-1.0",
        sha256="0" * 64,
    )


def toy_store(folder: Path, *, cars: int = 3, views: int = 4) -> PatchStore:
    with StoreWriter(folder, source="toy") as writer:
        for car in range(cars):
            for view in range(views):
                writer.append(toy_record(car, view, azimuth_deg=40.0 + 360.0 * view / views))
    store = open_store(folder)
    write_splits(store)
    return open_store(folder)
