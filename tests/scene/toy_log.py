"""A driving log made on the spot: a textured road, a sky, a camera that drives, and real cars of the bundled model.

The road's colour is a function of the world position, so that what a deleted car had hidden is known exactly.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from carstudio.fitting.car_file import Car
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_y
from carstudio.images import encode_png
from carstudio.models.interface import Latents
from carstudio.scene.graph import CarRef, FileRef, PlacedBox, Scene, SceneFrame, Track
from carstudio.scene.shelf import CarShelf
from carstudio.training.bundled import bundled_models
from carstudio.training.checkpoint import describe_model
from models.codes import drawn_latents

WIDTH, HEIGHT, HEIGHT_M = 160, 96, 1.65
INTRINSICS = (120.0, 120.0, 80.0, 40.0)
STEP_M = 0.8  # the camera drives this far from frame to frame
SIZE = (4.0, 1.5, 1.8)
SKY, WALL = np.array([180.0, 200.0, 230.0]), np.array([30.0, 30.0, 160.0])


def placed(x: float = 0.0, z: float = 10.0, yaw: float = -np.pi / 2, *, lift: float = 0.0) -> PlacedBox:
    """A car that stands on the road (or `lift` above it)."""
    turn = quaternion_from_rotation(rotation_y(torch.tensor(yaw, dtype=torch.float64))).tolist()
    return PlacedBox((float(x), HEIGHT_M - SIZE[1] / 2 - lift, float(z)), SIZE, tuple(turn))


def pose(index: int) -> tuple[tuple[float, ...], ...]:
    matrix = np.eye(4)
    matrix[2, 3] = STEP_M * index
    return tuple(tuple(row) for row in matrix.tolist())


def road_colour(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a point of the road, world metres."""
    waves = np.stack([np.sin(2.1 * x + 0.3 * z), np.cos(1.3 * z), np.sin(0.9 * x - 1.1 * z)], axis=-1)
    return 110 + 30 * waves


def photograph(index: int, blocks: tuple[PlacedBox, ...] = ()) -> np.ndarray:
    """Road and sky as frame `index` sees them; `blocks` stand there as blue rectangles (the boxes' outlines)."""
    from carstudio.scene.footprint import outline_mask

    fx, fy, cx, cy = INTRINSICS
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    below = v > cy
    z = np.where(below, HEIGHT_M * fy / np.where(below, v - cy, 1.0), 0.0)
    colours = np.where(below[..., None], road_colour((u - cx) / fx * z, z + STEP_M * index), SKY)
    for block in blocks:
        colours[outline_mask(block, Camera(torch.tensor(INTRINSICS), WIDTH, HEIGHT))] = WALL
    return np.clip(np.round(colours), 0, 255).astype(np.uint8)


def latents(seed: int) -> Latents:
    """Codes of a car by chance."""
    return drawn_latents(torch.Generator().manual_seed(seed))


def shelve(folder: Path, name: str, seed: int) -> CarRef:
    sha256 = describe_model(bundled_models()["car-gaussians"]).sha256
    car = Car(latents(seed), SIZE, "car-gaussians", sha256, name, "CC0-1.0", provenance={"scene_key": "toy"})
    return CarShelf(folder).add(car, name)


def toy_scene(folder: Path, *, frames: int = 3, tracks: dict[str, list[PlacedBox]] | None = None) -> Scene:
    """A scene below `folder/scene`, its photographs below `folder/log`; by default two parked cars.

    `tracks` gives each track's boxes in frame 0's camera order: one per frame.
    """
    if tracks is None:
        tracks = {
            "1": [placed(2.6, 12.0 - STEP_M * i) for i in range(frames)],
            "2": [placed(-2.4, 15.0 - STEP_M * i, np.pi / 2) for i in range(frames)],
        }
    root, made = folder / "log", []
    for i in range(frames):
        path = f"image_02/0001/{i:06d}.png"
        data = encode_png(photograph(i, tuple(boxes[i] for boxes in tracks.values())))
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_bytes(data)
        made.append(
            SceneFrame(
                index=i,
                name=f"{i:06d}",
                image=FileRef(path, hashlib.sha256(data).hexdigest()),
                width=WIDTH,
                height=HEIGHT,
                intrinsics=INTRINSICS,
                camera_offset=(0.06, -0.001, 0.003),
                world_from_camera=pose(i),
            )
        )
    held = {
        name: Track(
            track_id=name,
            boxes=dict(enumerate(boxes)),
            car=shelve(folder / "scene", f"track-{name}", seed),
            labels={i: {"box2d": [10.0, 10.0, 50.0, 50.0], "occlusion": 1, "track": int(name)} for i in range(frames)},
        )
        for seed, (name, boxes) in enumerate(tracks.items())
    }
    return Scene(root=str(root), source="toy", licence="CC0-1.0", frames=tuple(made), tracks=held)


def inserted(scene: Scene, track_id: str, boxes: dict[int, PlacedBox]) -> Scene:
    """The scene with one more car, which looks like track 1's."""
    track = replace(scene.tracks["1"], track_id=track_id, boxes=boxes, is_drawn=True, labels={})
    return scene.with_track(track)
