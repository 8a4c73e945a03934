"""Photographs of a car with exact truth: mask, depth, 3-D box and camera.

A `Renderer` makes the colours: the ray caster, by the mean of 2 x 2 rays to a pixel, or another. Mask and depth are
always those of the exact ray through a pixel's centre: it is "car" exactly when its centre is (no majority vote).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from carstudio.synthetic.cameras import CameraKind, Viewpoint, draw_viewpoint, viewpoint_at
from carstudio.synthetic.cars import Car
from carstudio.synthetic.drives import draw_drive, turned_views
from carstudio.synthetic.light import Light, draw_light
from carstudio.synthetic.sensor import Sensor, develop, draw_sensor
from carstudio.synthetic.shading import Scene, prepare_scene, shade
from carstudio.synthetic.street import draw_street
from carstudio.synthetic.tracing import Tracer

SUBPIXELS = (0.25, 0.75)
Radiance = Float[np.ndarray, "height width 3"]
# Linear radiance of the picture from a viewpoint; the number seeds what is drawn at random.
Render = Callable[[Viewpoint, int], Radiance]


@runtime_checkable
class Renderer(Protocol):
    """Makes pictures of scenes. `name` is what is written beside a photo; instances are pickled for workers."""

    @property
    def name(self) -> str:
        """The program, and what else decides its pixels."""

    def prepare(self, scene: Scene) -> Render:
        """Whatever all views of a scene share."""


@dataclass(frozen=True)
class RayCaster:
    """Our own shading of embree's hits: quick, free of noise, with everything a photo needs to be learned from."""

    name: str = "embree"

    def prepare(self, scene: Scene) -> Render:
        """Nothing is random here: the seed is not used."""

        def render(viewpoint: Viewpoint, seed: int) -> Radiance:
            size, per_pixel = viewpoint.camera.width, len(SUBPIXELS) ** 2
            origins, directions = unit_rays(viewpoint)
            samples = np.minimum(shade(scene, origins, directions), 8.0)  # a sun glint must not whiten its whole pixel
            return samples.reshape(size, size, per_pixel, 3).mean(axis=2)

        return render


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


def unit_rays(viewpoint: Viewpoint) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Origins and unit directions (car frame, float32) of the rays whose mean is a pixel, row by row."""
    positions = pixel_positions(viewpoint.camera.width, SUBPIXELS)
    origins, directions = (part.astype(np.float32) for part in viewpoint.rays(positions))
    return origins, directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def take_photograph(
    scene: Scene, viewpoint: Viewpoint, sensor: Sensor, rng: np.random.Generator, radiance: Radiance | None = None
) -> Photograph:
    """Photograph a scene: `radiance` (by default the ray caster's) as the sensor shows it, with exact truth."""
    if radiance is None:
        radiance = RayCaster().prepare(scene)(viewpoint, 0)
    mask, depth = exact_truth(scene.tracer, viewpoint)
    return Photograph(develop(radiance, sensor, rng), mask, depth, viewpoint, scene.light)


def draw_scene(car: Car, rng: np.random.Generator) -> Scene:
    """The car in a street and light of its own."""
    light = draw_light(rng)
    return prepare_scene(Tracer(car.mesh), draw_street(rng, float(car.mesh.size[1]) / 2), light)


def draw_azimuths(rng: np.random.Generator, num: int) -> Float[np.ndarray, " n"]:
    """Directions all around, one drawn in each of `num` equal sectors, in shuffled order, rad."""
    return rng.permutation((np.arange(num) + rng.random(num)) / num + rng.random()) % 1 * 2 * np.pi


@dataclass(frozen=True)
class Shot:
    """All that a photograph is developed from; `rng` draws the sensor's noise."""

    viewpoint: Viewpoint
    sensor: Sensor
    radiance: Radiance
    rng: np.random.Generator


def draw_photographs(
    car: Car,
    *,
    seed: tuple[int, ...],
    num_views: int,
    size_px: int,
    cameras: CameraKind,
    renderer: Renderer | None = None,
) -> list[Photograph]:
    """Views of one car under one light, all around it. View k of a seed is the same whoever asks for it.

    Cameras, light and truth are the same for every renderer (the ray caster by default).
    """
    scene = draw_scene(car, np.random.default_rng([*seed, 1]))
    shots = draw_shots(car, scene, seed=seed, num_views=num_views, size_px=size_px, cameras=cameras, renderer=renderer)
    return [take_photograph(scene, shot.viewpoint, shot.sensor, shot.rng, shot.radiance) for shot in shots]


def draw_shots(
    car: Car,
    scene: Scene,
    *,
    seed: tuple[int, ...],
    num_views: int,
    size_px: int,
    cameras: CameraKind,
    renderer: Renderer | None = None,
) -> Iterator[Shot]:
    """What `draw_photographs` develops, one view after the other."""
    render = (renderer or RayCaster()).prepare(scene)
    azimuths = draw_azimuths(np.random.default_rng([*seed, 2]), num_views)
    for view in range(num_views):
        rng = np.random.default_rng([*seed, 3, view])
        viewpoint = draw_viewpoint(rng, car.mesh, kind=cameras, azimuth_rad=float(azimuths[view]), size_px=size_px)
        sensor, noise = draw_sensor(rng), np.random.default_rng([*seed, 4, view]).integers(2**30)
        yield Shot(viewpoint, sensor, render(viewpoint, int(noise)), rng)


def photograph_drive(
    car: Car, *, seed: tuple[int, ...], num_frames: int, num_turns: int, size_px: int, renderer: Renderer | None = None
) -> list[Photograph]:
    """The frames of a drive past a car, then the car of its middle frame after 1 ... `num_turns` - 1 turns.

    One light and one sensor for all; what turns is the camera about the car, so that light stays on the same side of
    it, as it does on a car that a model has learned and turns.
    """
    scene = draw_scene(car, np.random.default_rng([*seed, 1]))
    render = (renderer or RayCaster()).prepare(scene)
    rng = np.random.default_rng([*seed, 5])
    drive = draw_drive(rng, car.mesh, num_frames=num_frames, size_px=size_px)
    turned = turned_views(rng, car.mesh, drive[num_frames // 2], num_turns=num_turns, size_px=size_px)
    sensor = draw_sensor(np.random.default_rng([*seed, 6]))
    photographs = []
    for view, viewpoint in enumerate([*drive, *turned]):
        rng = np.random.default_rng([*seed, 7, view])
        radiance = render(viewpoint, int(rng.integers(2**30)))
        photographs.append(take_photograph(scene, viewpoint, sensor, rng, radiance))
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
