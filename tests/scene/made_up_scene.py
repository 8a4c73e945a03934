"""A scene without photographs: a camera that drives a bend, parked cars, a van; cars with latents drawn by chance."""

import math
from pathlib import Path

import numpy as np
import torch

from carstudio.fitting.car_file import Car
from carstudio.scene.graph import FileRef, PlacedBox, Scene, SceneFrame, Track
from carstudio.scene.places import box_standing, turn_y
from carstudio.scene.poses import to_matrix
from carstudio.scene.shelf import CarShelf
from carstudio.training.checkpoint import describe_model
from models.codes import drawn_latents

FRAMES = 12
SIZE = (4.0, 1.5, 1.8)
HEIGHT_M = 1.65


def camera_pose(index: int, *, bend: float = 0.02) -> np.ndarray:
    """`world_from_camera`: 1.5 m a frame, turning `bend` rad to the right each."""
    pose = np.eye(4)
    for step in range(index):
        pose[:3, 3] += pose[:3, 2] * 1.5
        pose[:3, :3] = turn_y(bend * (step + 1))
    return pose


def frame(index: int, *, has_pose: bool = True) -> SceneFrame:
    return SceneFrame(
        index=index,
        name=f"{index:06d}",
        image=FileRef(f"image_02/0000/{index:06d}.png", "0" * 64),
        width=1242,
        height=375,
        intrinsics=(721.5, 721.5, 609.6, 172.9),
        world_from_camera=to_matrix(camera_pose(index)) if has_pose else None,
    )


def parked(index: int, x: float, z: float, yaw: float = -math.pi / 2) -> PlacedBox:
    """A car that stands in the world at (x, z) of the first camera, seen from frame `index`."""
    pose = camera_pose(index)
    bottom = pose[:3, :3].T @ (np.array([x, HEIGHT_M, z]) - pose[:3, 3])
    return box_standing(pose[:3, :3].T @ turn_y(yaw), bottom, SIZE)


def made_up_scene(*, has_poses: bool = True) -> Scene:
    """Tracks 1, 2 (parked right), 3 (parked left, from frame 4 on; never lifted), 7 (a van)."""
    frames = tuple(frame(index, has_pose=has_poses) for index in range(FRAMES))

    def track(name: str, x: float, z: float, first: int = 0, kind: str = "Car") -> Track:
        boxes = {index: parked(index, x, z) for index in range(first, FRAMES)}
        labels = {index: {"type": kind, "label": f"{kind} 0 0"} for index in boxes}
        return Track(track_id=name, type=kind, boxes=boxes, labels=labels)

    tracks = [track("1", 4.0, 25.0), track("2", 4.5, 32.0), track("3", -6.0, 30.0, 4), track("7", -7.0, 40.0, 0, "Van")]
    return Scene(
        root="/nowhere", source="made-up", licence="CC0-1.0", frames=frames, tracks={t.track_id: t for t in tracks}
    )


def made_up_car(seed: int, size: tuple[float, float, float] = SIZE) -> Car:
    """A car of the bundled model whose codes are drawn by chance."""
    generator = torch.Generator().manual_seed(seed)
    return Car(
        latents=drawn_latents(generator),
        size=size,
        model_name="car-gaussians",
        model_sha256=describe_model("car-gaussians").sha256,
        instance_id=f"made-up-{seed}",
        licence="CC0-1.0",
    )


def scene_with_cars(folder: Path, *, has_poses: bool = True) -> tuple[Scene, CarShelf]:
    """The scene with cars for tracks 1, 2 and 7 on a shelf, and one more, `spare`, that no track has."""
    from dataclasses import replace

    scene, shelf = made_up_scene(has_poses=has_poses), CarShelf(folder)
    for seed, name in enumerate(("1", "2", "7")):
        ref = shelf.add(made_up_car(seed), f"track-{name}")
        scene = scene.with_track(replace(scene.tracks[name], car=ref))
    shelf.add(made_up_car(9, (4.6, 1.4, 1.9)), "spare")
    return scene, shelf
