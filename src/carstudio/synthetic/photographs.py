"""Photographs of a car with exact truth: mask, depth, 3-D box and camera.

The colour of a pixel is the mean of 2 x 2 rays; mask and depth are those of the ray through the pixel's centre, so a
pixel is "car" exactly when its centre is (no majority vote).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from carstudio.synthetic.cameras import CameraKind, Viewpoint, draw_viewpoint, viewpoint_at
from carstudio.synthetic.cars import Car
from carstudio.synthetic.light import Light, draw_light
from carstudio.synthetic.sensor import Sensor, develop, draw_sensor
from carstudio.synthetic.shading import Scene, prepare_scene, shade
from carstudio.synthetic.street import draw_street
from carstudio.synthetic.tracing import Tracer

SUBPIXELS = (0.25, 0.75)


@dataclass(frozen=True)
class Photograph:
    """A photo with what is exactly known. `depth_m` is camera z, NaN beside the car."""

    image: UInt8[np.ndarray, "height width 3"]
    mask: Bool[np.ndarray, "height width"]
    depth_m: Float[np.ndarray, "height width"]
    viewpoint: Viewpoint
    light: Light


def pixel_positions(size_px: int, offsets: tuple[float, ...]) -> Float[np.ndarray, "n 2"]:
    """Image positions, row by row, `len(offsets)`^2 to a pixel."""
    v, u, b, a = np.meshgrid(np.arange(size_px), np.arange(size_px), offsets, offsets, indexing="ij")
    return np.stack([u + a, v + b], axis=-1).reshape(-1, 2)


def exact_truth(
    tracer: Tracer, viewpoint: Viewpoint
) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Mask and depth (camera z, m; NaN beside the car) by the rays through the pixel centres."""
    size = viewpoint.camera.width
    origins, directions = viewpoint.rays(pixel_positions(size, (0.5,)))
    hits = tracer.first_hits(origins, directions)
    depth = np.full(size * size, np.nan, np.float32)
    depth[hits.ray] = hits.distance  # directions have camera z = 1
    picture_m = depth.reshape(size, size)
    return np.isfinite(picture_m), picture_m


def take_photograph(scene: Scene, viewpoint: Viewpoint, sensor: Sensor, rng: np.random.Generator) -> Photograph:
    """Photograph a scene."""
    size, per_pixel = viewpoint.camera.width, len(SUBPIXELS) ** 2
    origins, directions = (part.astype(np.float32) for part in viewpoint.rays(pixel_positions(size, SUBPIXELS)))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    samples = np.minimum(shade(scene, origins, directions), 8.0)  # a sun glint must not whiten its whole pixel
    radiance = samples.reshape(size, size, per_pixel, 3).mean(axis=2)
    mask, depth = exact_truth(scene.tracer, viewpoint)
    return Photograph(develop(radiance, sensor, rng), mask, depth, viewpoint, scene.light)


def draw_scene(car: Car, rng: np.random.Generator) -> Scene:
    """The car in a street and light of its own."""
    light = draw_light(rng)
    return prepare_scene(Tracer(car.mesh), draw_street(rng, float(car.mesh.size[1]) / 2), light)


def draw_azimuths(rng: np.random.Generator, num: int) -> Float[np.ndarray, " n"]:
    """Directions all around, one drawn in each of `num` equal sectors, in shuffled order, rad."""
    return rng.permutation((np.arange(num) + rng.random(num)) / num + rng.random()) % 1 * 2 * np.pi


def draw_photographs(
    car: Car, *, seed: tuple[int, ...], num_views: int, size_px: int, cameras: CameraKind
) -> list[Photograph]:
    """Views of one car under one light, all around it. View k of a seed is the same whoever asks for it."""
    scene = draw_scene(car, np.random.default_rng([*seed, 1]))
    azimuths = draw_azimuths(np.random.default_rng([*seed, 2]), num_views)
    photographs = []
    for view in range(num_views):
        rng = np.random.default_rng([*seed, 3, view])
        viewpoint = draw_viewpoint(rng, car.mesh, kind=cameras, azimuth_rad=float(azimuths[view]), size_px=size_px)
        photographs.append(take_photograph(scene, viewpoint, draw_sensor(rng), rng))
    return photographs


def picture(
    car: Car,
    *,
    azimuth_deg: float = 35.0,
    elevation_deg: float = 12.0,
    distance_m: float = 9.0,
    size_px: int = 512,
    seed: int = 0,
) -> Photograph:
    """One picture of a car from a chosen side, for documentation: azimuth 0 shows the front, 90 the left side."""
    viewpoint = viewpoint_at(
        car.mesh,
        azimuth_rad=float(np.radians(azimuth_deg)),
        elevation_rad=float(np.radians(elevation_deg)),
        distance_m=distance_m,
        size_px=size_px,
    )
    clean = Sensor(0.2, np.ones(3), 0.0, 0.002, 0.0005, 0.3, 95)
    return take_photograph(
        draw_scene(car, np.random.default_rng([seed, 1])), viewpoint, clean, np.random.default_rng(0)
    )
