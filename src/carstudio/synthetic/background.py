"""Radiance of the surroundings along rays that miss the car (seen directly or mirrored in paint and glass)."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.light import Colours, Light
from carstudio.synthetic.street import END_M, Street

# Irradiance (rgb) that arrives at points of the ground.
GroundLight = Callable[[Float[np.ndarray, "n 3"]], Colours]


def radiance(
    street: Street,
    light: Light,
    origins: Float[np.ndarray, "n 3"],
    directions: Float[np.ndarray, "n 3"],
    ground_light: GroundLight,
) -> Colours:
    """Sky, houses and ground along rays; `ground_light` knows the car's shadow."""
    rgb = light.sky(directions)
    distance = np.full(len(origins), np.inf, np.float32)
    s0, c0 = street.to_street(origins)
    ds, dc = street.to_street(directions)
    horizontal = np.maximum(np.hypot(ds, dc), 1e-6)
    for row, side in enumerate((-1.0, 1.0)):
        wall_c = street.lane + side * (street.half_width + street.row_distance[row])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (wall_c - c0) / dc
        up = street.ground_y - (origins[:, 1] + t * directions[:, 1])
        index = np.flatnonzero(
            ((wall_c - c0) * side > 0) & (t > 0) & (t * horizontal < END_M) & (up > 0) & (up < 16) & (t < distance)
        )
        colour, stands = street.facade(row, (s0 + t * ds)[index], up[index])
        index, colour = index[stands], colour[stands]
        rgb[index] = colour * _wall_light(street, light, side)
        distance[index] = t[index]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (street.ground_y - origins[:, 1]) / directions[:, 1]
    index = np.flatnonzero((directions[:, 1] > 1e-4) & (t < distance) & (t * horizontal < END_M))
    points = origins[index] + t[index, None] * directions[index]
    rgb[index] = street.ground_colour(points) * ground_light(points) / np.float32(np.pi)
    distance[index] = t[index]
    haze = np.clip(distance * horizontal / END_M, 0, 1)[:, None] ** 2 * 0.6
    far = np.isinf(distance) & (directions[:, 1] > -0.02)
    haze[np.isinf(distance)] = 0
    rgb[far] = 0.5 * light.horizon * np.array([0.75, 0.85, 0.8])
    return (rgb * (1 - haze) + 0.7 * light.horizon * haze).astype(np.float32)


def _wall_light(street: Street, light: Light, side: float) -> Float[np.ndarray, "3"]:
    """Radiance of a white wall of the row on one side."""
    normal_s = np.array([np.sin(street.heading_rad), 0.0, -np.cos(street.heading_rad)]) * side
    sun = light.sun * max(float(normal_s @ light.to_sun), 0)
    sky = (light.zenith + light.horizon) / 2 * np.pi / 2
    return ((sun + sky) / np.pi).astype(np.float32)


def open_ground_light(light: Light) -> GroundLight:
    """The ground far from the car: sun and the whole sky."""
    flat = light.sun * max(-float(light.to_sun[1]), 0) + (0.6 * light.zenith + 0.4 * light.horizon) * np.pi

    def irradiance(points: Float[np.ndarray, "n 3"]) -> Colours:
        return np.broadcast_to(flat.astype(np.float32), (len(points), 3))

    return irradiance
