"""One edited frame: the photograph, what cars had hidden filled in, and all drawn cars merged in by metric depth.

Pixels that no edit touches keep the photograph's bytes.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from carstudio.errors import InputError
from carstudio.files import inside
from carstudio.geometry.camera import Camera
from carstudio.images import decode_depth, decode_image, read_image_file
from carstudio.perception.monocular_depth import estimate_inverse_depth
from carstudio.scene.background_depth import align_depth, background_depth, hiding_depth, is_ground
from carstudio.scene.filling import fill_hole
from carstudio.scene.footprint import any_of, body_mask, ground_mask, ground_rectangle, grown, outline_mask
from carstudio.scene.frame_jobs import DrawingSettings, FrameJob, frame_job
from carstudio.scene.graph import FileRef, PlacedBox, Scene, SceneFrame
from carstudio.scene.ground import Ground, find_ground
from carstudio.scene.layers import FAINTEST
from carstudio.scene.lidar import background_points, sparse_depth
from carstudio.scene.matching import GAMMA
from carstudio.scene.object_stack import ObjectStack, stack_objects
from carstudio.scene.shadow import contact_shadow
from carstudio.scene.truth import ObjectTruth, truth_of

_OUTLINE_PX = 3  # around a deleted car's box: labels are that inexact, and cameras blur
_HOLE_REACH_M = 0.35  # of ground around a deleted car: its contact shadow
_SEEN = 0.25  # opacity above which an object of the photograph is not painted over by a fill behind it
_KEPT_PHOTOS = 24  # per process
# Cityscapes' label ids; what is not known is 255, which its tools ignore.
SEMANTIC = {"Car": 26, "Van": 26, "Truck": 27, "Bus": 28, "Tram": 31, "Pedestrian": 24, "Person": 24, "Cyclist": 25}
UNLABELLED, IGNORED = 0, 255


@dataclass(frozen=True, kw_only=True)
class DrawnFrame:
    """A frame's pictures and truth. `depth_m` is inf where unknown; only `touched` pixels may differ from the photo."""

    rgb: UInt8[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    instances: UInt16[np.ndarray, "height width"]
    semantic: UInt8[np.ndarray, "height width"]
    touched: Bool[np.ndarray, "height width"]
    truths: tuple[ObjectTruth, ...]
    ground_source: str
    filled_px: int
    filled_from_frames_px: int


def render_frame(
    original: Scene, edited: Scene, index: int, scene_folder: Path | str, *, settings: DrawingSettings | None = None
) -> DrawnFrame:
    """Draw one frame of an edited scene (frame number `index`), without matching it to the log's other frames."""
    return draw_frame(frame_job(original, edited, index, str(scene_folder), settings=settings))


def draw_frame(job: FrameJob) -> DrawnFrame:
    """Draw a frame; `InputError` when a photograph or car is not what the scene was made from."""
    photo, camera = read_photo(job.root, job.frame), job.frame.camera()
    boxes = [placed.box for placed in job.objects if not placed.is_drawn] + list(job.gone)
    with_car = [placed for placed in job.objects if placed.car is not None]
    solid = [placed.box for placed in job.objects if placed.car is None]
    moving = [*job.gone, *(placed.box for placed in with_car if not placed.is_drawn)]
    points = _points(job, moving)
    ground = find_ground(points, boxes)
    hole = _hole(job, ground, camera)
    depth = _background(job, photo, camera, ground, points, solid, hole)
    stack = stack_objects(job, with_car, camera, hiding_depth(depth, ground, camera))
    hole &= ~_protected(job, stack, camera)
    on_ground = is_ground(depth, ground, camera)
    avoid = any_of((outline_mask(placed.box, camera) for placed in job.objects if not placed.is_drawn), camera)
    filled = fill_hole(
        photo,
        hole,
        avoid=avoid,
        on_ground=on_ground,
        depth_m=depth,
        frame=job.frame,
        neighbours=job.neighbours,
        read=partial(read_photo, job.root),
    )
    shade = _shade(job, ground, camera, on_ground) * (1 - stack.undrawn_weight)
    rgb, touched = _painted(photo, filled.image, hole, stack, shade, job)
    instances = stack.instances()
    drawn_numbers = [placed.number for placed in with_car if placed.is_drawn]
    drawn = np.isin(instances, drawn_numbers)
    truths = [truth_of(p, camera, instances, stack.alone.get(p.number), drawn) for p in job.objects]
    total = stack.weight + stack.undrawn_weight
    mean = stack.depth_sum / np.maximum(total, 1e-6)
    return DrawnFrame(
        rgb=rgb,
        depth_m=np.where(total >= 0.5, mean, depth),
        instances=instances,
        semantic=_semantic(job, instances, camera),
        touched=touched,
        truths=tuple(truths),
        ground_source=ground.source,
        filled_px=int(hole.sum()),
        filled_from_frames_px=int(filled.is_seen.sum()),
    )


def read_photo(root: str, frame: SceneFrame) -> UInt8[np.ndarray, "height width 3"]:
    """The photograph of a frame; `InputError` when it is gone or is not the one the scene was made from."""
    image = _photo(root, frame.image)
    if image.shape[:2] != (frame.height, frame.width):
        raise InputError(
            f"{Path(root) / frame.image.path}: expected {frame.width} x {frame.height} px, found "
            f"{image.shape[1]} x {image.shape[0]}; make the scene again"
        )
    return image


@lru_cache(maxsize=_KEPT_PHOTOS)
def _photo(root: str, ref: FileRef) -> UInt8[np.ndarray, "height width 3"]:
    image = decode_image(_checked(root, ref, "photograph"), name=ref.path)
    image.flags.writeable = False
    return image


def _checked(root: str, ref: FileRef, what: str) -> bytes:
    path = inside(Path(root), ref.path)
    data = read_image_file(path)
    if hashlib.sha256(data).hexdigest() != ref.sha256:
        raise InputError(
            f"{path}: {what} is not the one that the scene was made from (its sha256 differs); restore it, or make "
            "the scene again"
        )
    return data


def _points(job: FrameJob, moving: Sequence[PlacedBox]) -> Float[np.ndarray, "n 3"] | None:
    if job.settings.depth == "ground":
        return None
    return background_points(job.root, job.frame, moving, job.scans)


def _background(
    job: FrameJob,
    photo: UInt8[np.ndarray, "height width 3"],
    camera: Camera,
    ground: Ground,
    points: Float[np.ndarray, "n 3"] | None,
    solid: Sequence[PlacedBox],
    hole: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    network = None
    if job.settings.depth == "auto" and job.frame.depth is not None:
        own = decode_depth(_checked(job.root, job.frame.depth, "depth image"), name=job.frame.depth.path)
        network = np.where(np.isfinite(own), own, np.inf).astype(np.float64)
    elif job.settings.depth == "auto" and job.settings.depth_network is not None:
        known = sparse_depth(points, camera) if points is not None else ground.depth(camera)
        if points is None:
            objects = [placed.box for placed in job.objects if not placed.is_drawn] + list(job.gone)
            free = ~any_of((outline_mask(box, camera) for box in objects), camera)
            known = np.where(free & (known > 0) & (known < 30), known, np.inf)
            known[: int(camera.height * 0.6)] = np.inf  # only the road just ahead is sure to be ground
        network = align_depth(estimate_inverse_depth(job.settings.depth_network, photo), known)
    return background_depth(camera, ground, points=points, network=network, solid=solid, gone=hole)


def _hole(job: FrameJob, ground: Ground, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Pixels of cars that have gone, with their contact shadows."""
    outlines = (body_mask(box, camera, grow_px=_OUTLINE_PX) for box in job.gone)
    shadows = (ground_mask(box, ground, camera, reach_m=_HOLE_REACH_M) for box in job.gone)
    return any_of(outlines, camera) | any_of(shadows, camera)


def _protected(job: FrameJob, stack: ObjectStack, camera: Camera) -> Bool[np.ndarray, "height width"]:
    """Objects of the photograph that stand before all that has gone: their pixels stay."""
    kept = np.zeros((camera.height, camera.width), bool)
    if not job.gone:
        return kept
    nearest_gone = min(box.center[2] for box in job.gone)
    for placed in job.objects:
        if placed.is_drawn or placed.box.center[2] >= nearest_gone:
            continue
        alone = stack.alone.get(placed.number)
        kept |= body_mask(placed.box, camera) if alone is None else grown(alone > _SEEN, 1)
    return kept


def _shade(
    job: FrameJob, ground: Ground, camera: Camera, on_ground: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Share of its light that the ground loses to all drawn cars."""
    light = np.ones((camera.height, camera.width))
    if job.settings.has_shadows:
        for placed in job.objects:
            if placed.is_drawn:
                light *= 1 - contact_shadow(ground_rectangle(placed.box, ground), ground, camera)
    return np.where(on_ground, 1 - light, 0.0)


def _painted(
    photo: UInt8[np.ndarray, "height width 3"],
    filled: UInt8[np.ndarray, "height width 3"],
    hole: Bool[np.ndarray, "height width"],
    stack: ObjectStack,
    shade: Float[np.ndarray, "height width"],
    job: FrameJob,
) -> tuple[UInt8[np.ndarray, "height width 3"], Bool[np.ndarray, "height width"]]:
    """The picture, and which of its pixels are not the photograph's."""
    rgb, weight = stack.rgb, stack.weight
    if job.settings.is_matched and job.sensor.blur_px > _OWN_BLUR_PX and weight.any():
        sigma = (job.sensor.blur_px**2 - _OWN_BLUR_PX**2) ** 0.5
        rgb, weight = (np.asarray(cv2.GaussianBlur(layer, (0, 0), sigma)) for layer in (rgb, weight))
    touched = hole | (weight > FAINTEST) | (shade > FAINTEST)
    if not touched.any():
        return photo.copy(), touched
    rows, columns = np.nonzero(touched)
    share = weight[rows, columns][:, None].astype(np.float64)
    behind = filled[rows, columns] / 255 * ((1 - shade[rows, columns]) ** (1 / GAMMA))[:, None]
    value = behind * (1 - share) + rgb[rows, columns]
    if job.settings.is_matched and job.sensor.noise > 0:
        random = np.random.default_rng([job.frame.index, 0])
        grain = random.standard_normal(photo.shape[:2], np.float32)[rows, columns]
        value = value + (job.sensor.noise * np.maximum(share[:, 0], hole[rows, columns]) * grain)[:, None]
    result = photo.copy()
    result[rows, columns] = np.clip(np.round(value * 255), 0, 255).astype(np.uint8)
    return result, touched


_OWN_BLUR_PX = 0.5  # of a drawn car: each pixel already gathers what its cone covers


def _semantic(
    job: FrameJob, instances: UInt16[np.ndarray, "height width"], camera: Camera
) -> UInt8[np.ndarray, "height width"]:
    """Cityscapes' ids where an object's silhouette is known, 255 where only its box is, 0 elsewhere."""
    result = np.full(instances.shape, UNLABELLED, np.uint8)
    for placed in job.objects:
        if placed.car is None:
            result[outline_mask(placed.box, camera)] = IGNORED
    for placed in job.objects:
        if placed.car is not None:
            result[instances == placed.number] = SEMANTIC.get(placed.type, IGNORED)
    return result
