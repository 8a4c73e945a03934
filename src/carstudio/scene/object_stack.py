"""All cars of a frame merged with each other and the background, summed up per pixel.

The picture is worked on in strips, so that memory does not grow with its size.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt16

from carstudio.geometry.camera import Camera
from carstudio.models.interface import CategoryModel, Latents
from carstudio.scene.frame_jobs import FrameJob, PlacedObject
from carstudio.scene.graph import CarRef
from carstudio.scene.layers import bands, merge_layers, ray_lengths, trace_object
from carstudio.scene.matching import GAMMA
from carstudio.scene.shelf import CarShelf

_KEPT_CARS = 32  # per process


@lru_cache(maxsize=_KEPT_CARS)
def opened_car(scene_folder: str, ref: CarRef, run: str | None) -> tuple[CategoryModel, Latents]:
    """The car's model and latents, read once per process; `InputError` when it is not the scene's."""
    shelf = _shelf(scene_folder, run)
    car = shelf.load(ref)
    return shelf.model_of(car).eval(), car.latents


@lru_cache(maxsize=2)
def _shelf(scene_folder: str, run: str | None) -> CarShelf:
    return CarShelf(Path(scene_folder), () if run is None else (Path(run),))


@dataclass
class ObjectStack:
    """Sums over the objects of a frame, per pixel. Drawn and undrawn objects hide each other alike."""

    rgb: Float[np.ndarray, "height width 3"]  # of drawn objects, premultiplied
    weight: Float[np.ndarray, "height width"]  # visible share of drawn objects
    undrawn_weight: Float[np.ndarray, "height width"]
    depth_sum: Float[np.ndarray, "height width"]  # visible share times depth
    best_weight: Float[np.ndarray, "height width"]
    best_number: UInt16[np.ndarray, "height width"]
    alone: dict[int, Float[np.ndarray, "height width"]]

    def instances(self) -> UInt16[np.ndarray, "height width"]:
        """Number of the object that most is seen of, where objects make up half of the pixel."""
        shown = self.weight + self.undrawn_weight >= 0.5
        return np.where(shown, self.best_number, 0).astype(np.uint16)


def empty_stack(height: int, width: int) -> ObjectStack:
    """Sums of nothing."""

    def zeros() -> Float[np.ndarray, "height width"]:
        return np.zeros((height, width), np.float32)

    rgb, numbers = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.uint16)
    return ObjectStack(rgb, zeros(), zeros(), zeros(), zeros(), numbers, {})


def stack_objects(
    job: FrameJob, objects: Sequence[PlacedObject], camera: Camera, hiding_m: Float[np.ndarray, "height width"]
) -> ObjectStack:
    """All cars merged with each other and with the background, strip by strip."""
    stack = empty_stack(camera.height, camera.width)
    for placed in objects:
        stack.alone[placed.number] = np.zeros((camera.height, camera.width), np.float32)
    if not objects:
        return stack
    assert all(placed.car is not None for placed in objects), "only cars can be drawn"
    cars = [opened_car(job.scene_folder, p.car, job.settings.model) for p in objects if p.car is not None]
    side = job.settings.rays_per_side
    fine = camera.resize(camera.width * side, camera.height * side)
    chunk = min(model.chunk_rays for model, _ in cars)
    tile = max(model.tile_px for model, _ in cars) * side
    rows = max(tile, round(2 * chunk / fine.width / tile) * tile)
    for top, band in bands(fine, rows):
        traced = [
            trace_object(model, latents, placed.box.box(), band)
            for placed, (model, latents) in zip(objects, cars, strict=True)
        ]
        wall = hiding_m[top // side : (top + band.height) // side].repeat(side, axis=0).repeat(side, axis=1)
        background = torch.from_numpy(np.ascontiguousarray(wall)).float().flatten() * ray_lengths(band)
        layers = merge_layers(traced, background)
        for placed, layer in zip(objects, layers, strict=True):
            pixels, weight = layer.pixels.numpy(), layer.weight.numpy() / side**2
            row, column = (pixels // band.width + top) // side, pixels % band.width // side
            rgb = layer.rgb.numpy() / side**2
            parts = (weight, layer.alone.numpy() / side**2, layer.depth_m.numpy() * weight, rgb)
            _add(stack, placed, (row, column), parts)
    return stack


def _add(
    stack: ObjectStack, placed: PlacedObject, at: tuple[np.ndarray, np.ndarray], parts: tuple[np.ndarray, ...]
) -> None:
    """Add one object's share of a strip, several rays to a pixel."""
    if len(at[0]) == 0:
        return
    weight, alone, depth, rgb = parts
    top, bottom = int(at[0].min()), int(at[0].max()) + 1
    left, right = int(at[1].min()), int(at[1].max()) + 1
    shape = (bottom - top, right - left)
    flat = (at[0] - top) * shape[1] + at[1] - left

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(flat, values, shape[0] * shape[1]).reshape(shape).astype(np.float32)

    part = (slice(top, bottom), slice(left, right))
    shown = summed(weight)
    stack.alone[placed.number][part] += summed(alone)
    stack.depth_sum[part] += summed(depth)
    is_best = shown > stack.best_weight[part]
    stack.best_weight[part] = np.where(is_best, shown, stack.best_weight[part])
    stack.best_number[part] = np.where(is_best, placed.number, stack.best_number[part])
    if not placed.is_drawn:
        stack.undrawn_weight[part] += shown
        return
    stack.weight[part] += shown
    gain = np.array(placed.gain) ** (1 / GAMMA)
    for channel in range(3):
        lit = np.minimum(summed(rgb[:, channel]) * gain[channel], shown)
        stack.rgb[(*part, channel)] += lit.astype(np.float32)
