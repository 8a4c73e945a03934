"""Making drawn cars look as if this camera had taken them: exposure and white balance, sharpness, noise.

What is measured is measured once per log, not per frame, so that nothing flickers.
"""

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from carstudio.scene.background_depth import FARTHEST_M
from carstudio.scene.footprint import any_of, ground_mask, grown, outline_mask
from carstudio.scene.frame_jobs import Sensor
from carstudio.scene.graph import PlacedBox, Scene, SceneFrame, Vector3
from carstudio.scene.ground import Ground, find_ground

GAMMA = 2.2  # of photographs, near enough for ratios of light
ROAD = 0.38  # sRGB of dry asphalt in a photograph that is exposed as usual: KITTI's 0.30 to 0.45
_SAMPLES = 5  # frames that are looked at
_REBLUR_PX = 1.0
_SHARPEST = 0.1  # share of the edges taken for the camera's sharpness; others are out of focus or soft by nature
_RING_M = 1.2  # of ground around a car that tells how light it is there
_LEAST_PIXELS = 60

Photograph = UInt8[np.ndarray, "height width 3"]
Read = Callable[[SceneFrame], Photograph]


def blur_of(image: Photograph) -> float:
    """Standard deviation (px) of the blur of the sharpest strong edges (Zhuo and Sim, Pattern Recognition 2011, Eq. 4).

    A step edge blurred by s has a gradient 1 / s high; blurred again by s0 it falls by R = sqrt(s^2 + s0^2) / s.
    0 for a picture without edges.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    again = cv2.GaussianBlur(grey, (0, 0), _REBLUR_PX)
    first, second = _gradient(grey), _gradient(again)
    strong = first > max(8.0, float(np.percentile(first, 98)))
    if strong.sum() < _LEAST_PIXELS:
        return 0.0
    ratio = first[strong] / np.maximum(second[strong], 1e-6)
    sharp = float(np.quantile(ratio, 1 - _SHARPEST))
    variance = _REBLUR_PX**2 / max(sharp * sharp - 1, 1e-6)
    return max(0.0, variance - 1 / 12) ** 0.5  # the difference of two pixels is itself a mean over one


def _gradient(grey: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """The larger of the differences to the pixels to the right and below."""
    dx = np.abs(np.diff(grey, axis=1, append=grey[:, -1:]))
    dy = np.abs(np.diff(grey, axis=0, append=grey[-1:]))
    return np.maximum(dx, dy)


def noise_of(image: Photograph) -> float:
    """Standard deviation of the noise, 8-bit steps / 255, of the flattest parts (Immerkaer, CVIU 1996, in blocks)."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(grey, -1, kernel))[1:-1, 1:-1]
    side = 16
    rows, columns = response.shape[0] // side, response.shape[1] // side
    if rows == 0 or columns == 0:
        return 0.0
    blocks = response[: rows * side, : columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3))
    flat = grey[1 : rows * side + 1, 1 : columns * side + 1].reshape(rows, side, columns, side).mean(axis=(1, 3))
    exposed = blocks[(flat > 20) & (flat < 235)]  # clipped blacks and whites have no noise
    return float(np.quantile(exposed, 0.1)) * (np.pi / 2) ** 0.5 / 6 / 255 if exposed.size else 0.0


def sensor_of(frames: Sequence[SceneFrame], read: Read) -> Sensor:
    """Sharpness and noise of a log, medians over a few of its frames."""
    photos = [read(frame) for frame in sampled(frames)]
    if not photos:
        return Sensor()
    return Sensor(
        round(float(np.median([blur_of(photo) for photo in photos])), 3),
        round(float(np.median([noise_of(photo) for photo in photos])), 5),
    )


def sampled(frames: Sequence[SceneFrame]) -> list[SceneFrame]:
    """A few frames, evenly spread."""
    places = np.linspace(0, len(frames) - 1, min(_SAMPLES, len(frames)))
    return [frames[i] for i in sorted({int(place) for place in places})]


def gains_of(original: Scene, edited: Scene, foreign: frozenset[str], read: Read) -> dict[str, Vector3]:
    """Linear RGB gain of every drawn track, constant over the log; tracks without one are drawn as they are.

    A car of another log (`foreign` track ids) takes on the light of this one: the road's brightness and tint against an
    ordinary road's. Any car that now stands in other light than where it was photographed takes on the ground's there.
    """
    drawn = {name: track for name, track in edited.tracks.items() if track.is_drawn}
    light = _road_light(original, read) if foreign & set(drawn) else None
    result: dict[str, Vector3] = {}
    for name, track in drawn.items():
        here = [frame for frame in edited.frames if track.is_drawn_at(frame.index)]
        before = original.tracks.get(name)
        old = before.boxes if before is not None and name not in foreign else {}
        gain = _local_gain(original, here, track.boxes, old, read)
        colour = _foreign_gain(light) if name in foreign and light is not None else np.ones(3)
        red, green, blue = (round(float(value), 4) for value in np.clip(colour * gain, 0.4, 2.0))
        if (red, green, blue) != (1.0, 1.0, 1.0):
            result[name] = (red, green, blue)
    return result


def _foreign_gain(light: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    mean = float(light.mean())
    return np.asarray(np.clip(mean / ROAD**GAMMA, 0.6, 1.6) * np.clip(light / mean, 0.85, 1.18))


def _road_light(scene: Scene, read: Read) -> Float[np.ndarray, "3"] | None:
    """Linear RGB of the road 5 to 25 m ahead, median over pixels and frames; None where no road is to be seen."""
    found = []
    for frame in sampled(scene.frames):
        ground, free = _free_ground(scene, frame)
        depth = ground.depth(frame.camera())
        found += _median_light(read(frame), free & (depth > 5) & (depth < 25))
    return np.median(found, axis=0) if found else None


def _free_ground(scene: Scene, frame: SceneFrame) -> tuple[Ground, Bool[np.ndarray, "height width"]]:
    """The ground plane, and pixels that see it unless something unknown stands there."""
    boxes = [track.boxes[frame.index] for track in scene.tracks.values() if frame.index in track.boxes]
    camera = frame.camera()
    ground = find_ground(None, boxes)
    depth = ground.depth(camera)
    objects = grown(any_of((outline_mask(box, camera) for box in boxes), camera), 2)
    return ground, (depth > 0) & (depth < FARTHEST_M) & ~objects


def _median_light(photo: Photograph, mask: Bool[np.ndarray, "height width"]) -> list[Float[np.ndarray, "3"]]:
    pixels = photo[mask]
    if len(pixels) < _LEAST_PIXELS:
        return []
    return [np.asarray(np.median(pixels.astype(np.float64) / 255, axis=0)) ** GAMMA]


def _local_gain(
    scene: Scene, frames: Sequence[SceneFrame], new: Mapping[int, PlacedBox], old: Mapping[int, PlacedBox], read: Read
) -> float:
    """Light of the ground around where the car stands now, over that around where it was (or the road's); 1 if unsure.

    Half of the ratio (in stops) is believed, and small ones not at all: a darker patch of asphalt is no shade.
    """
    ratios = []
    for frame in sampled(frames):
        now, before = new[frame.index], old.get(frame.index)
        if now == before:
            continue
        ground, free = _free_ground(scene, frame)
        camera, photo = frame.camera(), read(frame)
        ring = [
            _median_light(photo, free & ground_mask(box, ground, camera, reach_m=_RING_M))
            for box in (now, before)
            if box
        ]
        if before is None:
            depth = ground.depth(camera)
            ring.append(_median_light(photo, free & (depth > 5) & (depth < 25)))
        if ring[0] and ring[1]:
            ratios.append(float(ring[0][0].mean() / max(ring[1][0].mean(), 1e-4)))
    if not ratios:
        return 1.0
    ratio = float(np.median(ratios)) ** 0.5
    return 1.0 if abs(ratio - 1) < 0.08 else float(np.clip(ratio, 0.7, 1.3))
