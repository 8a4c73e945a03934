"""Speed of drawing edited frames: one frame with five edited cars, and a clip. Usage: python -m bench.scene [--scene S]

Without --scene a log of KITTI's size is made up: noise for photographs, five cars of the bundled Gaussian model that
each stand elsewhere than in the photograph, so that five holes are filled and five cars are drawn.
"""

import argparse
import hashlib
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from carstudio.allocator import keep_freed_memory
from carstudio.fitting.car_file import Car
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_y
from carstudio.images import encode_png
from carstudio.models.car_gaussians import CarGaussiansConfig
from carstudio.models.interface import Latents
from carstudio.scene.drawing import draw_frame
from carstudio.scene.frame_jobs import PRESETS, frame_job
from carstudio.scene.graph import FileRef, PlacedBox, Scene, SceneFrame, Track
from carstudio.scene.scene_file import load_scene
from carstudio.scene.shelf import CarShelf
from carstudio.scene.writing import write_edited
from carstudio.training.bundled import bundled_models
from carstudio.training.checkpoint import describe_model

WIDTH, HEIGHT = 1242, 375
INTRINSICS = (721.5377, 721.5377, 609.5593, 172.854)
PLACES = ((-3.0, 8.0), (2.5, 11.0), (-2.0, 16.0), (3.0, 24.0), (0.5, 35.0))  # x, z, m
SHIFT_M = 1.4  # to the side: where each car is drawn


def made_up_scene(folder: Path, frames: int) -> Scene:
    """A log of noise with five cars, each driving 0.5 m per frame."""
    shelf, random = CarShelf(folder / "scene"), torch.Generator().manual_seed(0)
    described = describe_model(bundled_models()["car-gaussians"])
    assert isinstance(described.config, CarGaussiansConfig)
    sizes = (described.config.code_size, described.config.texture_size)
    size, turn = (4.2, 1.5, 1.8), quaternion_from_rotation(rotation_y(torch.tensor(-1.5, dtype=torch.float64)))
    tracks = {}
    for i, (x, z) in enumerate(PLACES):
        shape, texture = (torch.randn(1, size, generator=random) for size in sizes)
        codes = Latents(shape, texture)
        car = Car(
            codes, size, "car-gaussians", described.sha256, f"car-{i}", "CC0-1.0", provenance={"scene_key": "bench"}
        )
        boxes = {k: PlacedBox((x, 0.9, z + 0.5 * k), size, tuple(turn.tolist())) for k in range(frames)}
        tracks[str(i)] = Track(track_id=str(i), boxes=boxes, car=shelf.add(car, f"car-{i}"))
    return Scene(root=str(folder), source="bench", licence="CC0-1.0", frames=_photos(folder, frames), tracks=tracks)


def _photos(folder: Path, frames: int) -> tuple[SceneFrame, ...]:
    made = []
    for k in range(frames):
        soft = np.random.default_rng(k).integers(60, 200, (HEIGHT // 5 + 1, WIDTH // 5 + 1, 3), np.uint8)
        data = encode_png(soft.repeat(5, axis=0).repeat(5, axis=1)[:HEIGHT, :WIDTH])
        path = folder / f"{k:06d}.png"
        path.write_bytes(data)
        pose = np.eye(4)
        pose[2, 3] = 0.8 * k
        made.append(
            SceneFrame(
                index=k,
                name=path.stem,
                image=FileRef(path.name, hashlib.sha256(data).hexdigest()),
                width=WIDTH,
                height=HEIGHT,
                intrinsics=INTRINSICS,
                world_from_camera=tuple(tuple(row) for row in pose.tolist()),
            )
        )
    return tuple(made)


def five_moved(scene: Scene, index: int) -> Scene:
    """Five of the tracks with a car, the nearest in that frame, moved to the side in all their frames."""
    here = [t for t in scene.tracks.values() if t.car is not None and index in t.boxes]
    for track in sorted(here, key=lambda t: t.boxes[index].center[2])[:5]:
        boxes = {k: replace(b, center=(b.center[0] + SHIFT_M, *b.center[1:])) for k, b in track.boxes.items()}
        scene = scene.with_track(replace(track, boxes=boxes, is_drawn=True))
    return scene


def measure(action: Callable[[], object]) -> tuple[float, float]:
    """(wall seconds, processor seconds) of one call."""
    wall, processor = time.perf_counter(), time.process_time()
    action()
    return time.perf_counter() - wall, time.process_time() - processor


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(prog="bench.scene", description=__doc__)
    parser.add_argument("--scene", type=Path, help="a scene folder; a made-up log when absent")
    parser.add_argument("--frame", type=int, default=12, help="of --scene")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=30, help="of the clip")
    parser.add_argument("--workers", type=int, default=1, help="of the clip")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="fast")
    options = parser.parse_args()
    keep_freed_memory()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        scene = load_scene(options.scene) if options.scene else made_up_scene(folder, options.frames)
        scene_folder, index = options.scene or folder / "scene", options.frame if options.scene else 0
        edited, settings = five_moved(scene, index), PRESETS[options.preset]
        job = frame_job(scene, edited, index, str(scene_folder), settings=settings)
        drawn = draw_frame(job)  # models and photographs are read once
        found = [measure(lambda: draw_frame(job)) for _ in range(options.rounds)]
        wall, processor = (statistics.median(values) for values in zip(*found, strict=True))
        pixels = [truth.num_pixels or 0 for truth in drawn.truths if truth.is_drawn]
        print(
            f"torch {torch.__version__}, {torch.get_num_threads()} threads; preset {options.preset}; five cars of "
            f"{', '.join(str(p) for p in pixels)} px; {drawn.filled_px} px filled\n"
        )
        print("| what | wall s | CPU s |\n|---|---:|---:|")
        print(f"| one frame, warm, median of {options.rounds} | {wall:.2f} | {processor:.2f} |")
        clip = replace(scene, frames=scene.frames[: options.frames])
        clip_edited = replace(edited, frames=clip.frames)
        wall, processor = measure(
            lambda: write_edited(
                clip, clip_edited, scene_folder, folder / "out", workers=options.workers, settings=settings
            )
        )
        work = f"{processor:.1f}" if options.workers == 1 else "in the workers"
        print(f"| clip of {len(clip.frames)} frames written, {options.workers} workers | {wall:.1f} | {work} |")


if __name__ == "__main__":
    main()
