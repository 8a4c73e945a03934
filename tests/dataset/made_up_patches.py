"""Small stores of made-up patches: noise pictures with boxes that really project into them."""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.judging import judge_store
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, StoreWriter, open_store
from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.images import encode_png

FOCAL, WIDTH, HEIGHT = 700.0, 1200, 400


def photo(seed: int, width: int, height: int) -> np.ndarray:
    """Smooth noise: a picture that a perceptual hash can tell from others."""
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(0, 256, (7, 9, 3), dtype=np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)


def made_up_record(index: int, **changes: object) -> PatchRecord:
    """Patch `index`: a car 8 m to 30 m away, three views of each car; every fifth is poorly masked."""
    center, yaw = (1.5 * math.sin(index), 0.6, 8.0 + index % 23), 0.37 * index
    camera = Camera(torch.tensor([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], dtype=torch.float64), WIDTH, HEIGHT)
    size = (4.2, 1.5, 1.8)
    rotation = rotation_y(torch.tensor(yaw, dtype=torch.float64))
    outline = envelope(Box3D(torch.tensor(center).double(), torch.tensor(size).double(), rotation), camera)
    assert outline is not None
    x0, y0, x1, y1 = outline.tolist()
    left, top = int(x0), int(y0)
    width, height = min(WIDTH - 1, int(x1)) - left + 1, min(HEIGHT - 1, int(y1)) - top + 1
    mask = np.full((height, width), MaskValue.BACKGROUND, np.uint8)
    cv2.ellipse(mask, (width // 2, height // 2), (width // 2, height // (2 if index % 5 else 4)), 0, 0, 360, 255, -1)
    mask[:2, :3] = MaskValue.UNKNOWN
    image = encode_png(photo(index, width, height))
    record = PatchRecord(
        patch_id=f"p-{index:05d}",
        instance_id=f"car-{index // 3}",
        frame_id=f"{index:06d}",
        frame_index=index,
        source="made-up",
        image=image,
        mask=encode_png(mask),
        frame_path=f"{index:06d}.png",
        frame_width=WIDTH,
        frame_height=HEIGHT,
        crop_x0=left,
        crop_y0=top,
        crop_width=width,
        crop_height=height,
        fx=FOCAL,
        fy=FOCAL,
        cx=WIDTH / 2,
        cy=HEIGHT / 2,
        camera_source="calib:P2",
        box2d=(x0, y0, x1, y1),
        box_center=center,
        box_size=size,
        box_yaw=math.remainder(yaw, 2 * math.pi),
        mask_ratio=float((mask == MaskValue.CAR).mean()),
        box_iou=1.0,
        licence="CC0-1.0",
        sha256=hashlib.sha256(image).hexdigest(),
    )
    return replace(record, **changes)  # type: ignore[arg-type]  # fields by name, as the caller wishes


def made_up_store(
    path: Path, records: Iterable[PatchRecord], *, source: str = "made-up", recipe: FilterRecipe | None = None
) -> PatchStore:
    """A finished store of these patches, judged and split."""
    with StoreWriter(path, source=source) as writer:
        for record in records:
            writer.append(record)
    judge_store(open_store(path), recipe or FilterRecipe(height_px=40.0))
    write_splits(open_store(path))
    return open_store(path)
