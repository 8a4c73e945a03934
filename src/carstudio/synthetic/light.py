"""Sun and sky of one scene, in linear radiance (a clear zenith is about 1), directions in the car frame (y down)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Colours = Float[np.ndarray, "n 3"]
Directions = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Light:
    """`to_sun`: unit vector; `sun`: its irradiance (rgb) on a surface facing it; sky radiance at zenith and horizon."""

    to_sun: Float[np.ndarray, "3"]
    sun: Float[np.ndarray, "3"]
    zenith: Float[np.ndarray, "3"]
    horizon: Float[np.ndarray, "3"]
    is_sunny: bool

    def sky(self, directions: Directions) -> Colours:
        """Radiance of the sky; below the horizon that of the horizon."""
        up = np.clip(-directions[:, 1], 0, 1)[:, None]
        blend = (1 - up) ** 3.0
        glow = np.clip(directions @ self.to_sun.astype(directions.dtype), 0, 1)[:, None] ** 24
        radiance = self.zenith * (1 - blend) + self.horizon * blend + glow * self.sun * 0.08
        return radiance.astype(directions.dtype)


def draw_light(rng: np.random.Generator) -> Light:
    """Two in three scenes in the sun, as in KITTI; the rest under clouds. Sun 20 to 65 degrees high, any bearing."""
    is_sunny = bool(rng.random() < 0.66)
    bearing, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(20, 65))
    to_sun = np.array([np.cos(height) * np.cos(bearing), -np.sin(height), np.cos(height) * np.sin(bearing)])
    low = np.clip((np.radians(45) - height) / np.radians(30), 0, 1)  # a low sun is redder
    if is_sunny:
        sun = rng.uniform(3.0, 5.5) * np.array([1.0, 0.95 - 0.06 * low, 0.86 - 0.16 * low])
        zenith = rng.uniform(0.45, 0.8) * np.array([0.48, 0.68, 1.0])
        horizon = rng.uniform(0.9, 1.3) * np.array([0.86, 0.93, 1.0])
    else:
        sun = rng.uniform(0.05, 0.6) * np.array([1.0, 0.98, 0.95])
        zenith = rng.uniform(0.9, 1.3) * np.array([0.93, 0.97, 1.0])
        horizon = rng.uniform(0.6, 0.9) * np.array([0.93, 0.97, 1.0])
    return Light(to_sun, sun, zenith, horizon, is_sunny)
