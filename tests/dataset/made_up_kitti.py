"""A KITTI folder of noise pictures with labels that agree with their boxes, made on the spot."""

from pathlib import Path

import numpy as np
import torch

from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.images import encode_png

P2 = "P2 200 0 120 9 0 200 60 0.05 0 0 1 0.001"
WIDTH, HEIGHT = 240, 120


def car_line(x: float, z: float, kind: str = "Car") -> str:
    """A label whose 2-D box is its 3-D box's envelope, to the hundredth of a pixel as KITTI writes it."""
    camera = Camera(torch.tensor([200.0, 200.0, 120.0, 60.0]), WIDTH, HEIGHT)
    center = torch.tensor([x + (9 - 0.12) / 200, 1.0 - 0.75 + (0.05 - 0.06) / 200, z + 0.001])
    box = Box3D(center, torch.tensor([4.0, 1.5, 1.8]), rotation_y(torch.tensor(-1.2)))
    outline = envelope(box, camera)
    assert outline is not None
    words = " ".join(f"{value:.2f}" for value in outline.tolist())
    return f"{kind} 0 0 -1.2 {words} 1.5 1.8 4.0 {x} 1.0 {z} -1.2"


def made_up_kitti(root: Path, *, more_frames: int = 0) -> Path:
    """Three frames of sequence 0000: two cars (one hides the other), a van, DontCare; frame 2 is broken.

    `more_frames` with one car each may follow.
    """
    for folder in ("image_02/0000", "label_02", "calib"):
        (root / "training" / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for frame in range(3 + more_frames):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        (root / "training" / "image_02" / "0000" / f"{frame:06d}.png").write_bytes(encode_png(pixels))
    lines = [
        f"0 7 {car_line(0.0, 6.0)}",
        f"0 8 {car_line(0.8, 9.0)}",
        f"0 9 {car_line(-3.0, 12.0, 'Van')}",
        "0 -1 DontCare -1 -1 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10",
        f"1 7 {car_line(0.1, 5.0)}",
        f"2 7 {car_line(0.1, 5.0)} 0.9 extra",
    ]
    lines += [f"{frame} 7 {car_line(0.1, 5.0 + 0.1 * frame)}" for frame in range(3, 3 + more_frames)]
    (root / "training" / "label_02" / "0000.txt").write_text("\n".join(lines) + "\n")
    (root / "training" / "calib" / "0000.txt").write_text(P2 + "\n")
    return root
