"""The surroundings: a street with lane lines, kerbs and pavement between two rows of houses, trees and hedges.

Street frame: s along the street, c across it, up. The ground is the plane y = ground_y of the car frame; the rows are
two vertical planes; far away both ends close in haze. Everything is procedural, from the seed of the scene.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import zoom

from carstudio.synthetic.light import Colours, Directions, Light

PLOT_M = 9.0  # width of one house or tree group
NUM_PLOTS = 32
END_M = 90.0  # where the street ends in haze


@dataclass(frozen=True)
class Street:
    """One scene's surroundings. Colours are linear reflectances. Arrays over plots: [row (2), plot]."""

    ground_y: float
    heading_rad: float
    lane: float  # where the street's middle line lies, m across from the car
    half_width: float
    row_distance: tuple[float, float]
    asphalt: Float[np.ndarray, "3"]
    pavement: Float[np.ndarray, "3"]
    wall: Float[np.ndarray, "2 plots 3"]
    height: Float[np.ndarray, "2 plots"]
    is_green: Float[np.ndarray, "2 plots"]
    noise: Float[np.ndarray, "256 256"]

    def to_street(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
        """(s, c) of points or directions; the middle line is not yet taken off."""
        cos, sin = np.float32(np.cos(self.heading_rad)), np.float32(np.sin(self.heading_rad))
        return cos * points[:, 0] + sin * points[:, 2], cos * points[:, 2] - sin * points[:, 0]

    def noise_at(self, a: np.ndarray, b: np.ndarray, cell_m: float) -> np.ndarray:
        """Smooth noise in [0, 1] with details of a few `cell_m`, bilinear."""
        x, y = a / cell_m, b / cell_m
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = x - i, y - j
        i0, i1, j0, j1 = i & 255, (i + 1) & 255, j & 255, (j + 1) & 255
        low = self.noise[i0, j0] * (1 - v) + self.noise[i0, j1] * v
        return low * (1 - u) + (self.noise[i1, j0] * (1 - v) + self.noise[i1, j1] * v) * u

    def ground_colour(self, points: Float[np.ndarray, "n 3"]) -> Colours:
        """Reflectance of the ground."""
        s, c = self.to_street(points)
        off = np.abs(c - self.lane)
        grain = 0.75 + 0.5 * (0.5 * self.noise_at(s, c, 0.03) + 0.5 * self.noise_at(s + 77, c + 31, 0.35))
        rgb = self.asphalt * grain[:, None]
        is_paint = (off < 0.07) & (s % 6.0 < 3.0) | (np.abs(off - self.half_width + 0.35) < 0.06)
        rgb = np.where(is_paint[:, None], 0.55 * (0.6 + 0.4 * grain[:, None]), rgb)
        is_kerb = (off > self.half_width) & (off < self.half_width + 0.16)
        slab = np.where((s % 0.5 < 0.02) | (off % 0.5 < 0.02), 0.6, 1.0)
        rgb = np.where((off >= self.half_width)[:, None], self.pavement * (grain * slab)[:, None], rgb)
        rgb = np.where(is_kerb[:, None], 0.36 * grain[:, None], rgb)
        grass = np.array([0.075, 0.095, 0.04]) * (0.5 + grain[:, None])
        return np.where((off > self.half_width + 2.6)[:, None], grass, rgb).astype(np.float32)

    def facade(self, row: int, s: np.ndarray, up: np.ndarray) -> tuple[Colours, np.ndarray]:
        """Reflectance of a row of houses and trees at (s, up), and whether anything stands there."""
        plot = np.floor(s / PLOT_M).astype(int) % NUM_PLOTS
        rgb = self.wall[row, plot]
        height, green = self.height[row, plot], self.is_green[row, plot] > 0.5
        leaves = 0.5 * self.noise_at(s, up, 0.12) + 0.5 * self.noise_at(s + 9, up + 5, 0.8)
        is_window = (s % 2.6 > 0.8) & (s % 2.6 < 1.9) & (up % 2.9 > 0.9) & (up % 2.9 < 2.3)
        is_window &= (s % PLOT_M > 0.9) & (up < height - 0.5)
        shade = 0.85 + 0.3 * self.noise_at(s, up, 0.2)
        house = np.where(is_window[:, None], 0.05, rgb * shade[:, None])
        tree = rgb * (0.15 + 1.5 * leaves[:, None])
        top = np.where(green, height * (0.72 + 0.5 * self.noise_at(s, s * 0, 0.5)), height)
        return np.where(green[:, None], tree, house).astype(np.float32), up < top


def draw_street(rng: np.random.Generator, ground_y: float) -> Street:
    """A street; the car is parked along it or (one in three) stands across."""
    along = rng.choice([0.0, np.pi]) + np.radians(rng.normal(0, 3))
    heading = along if rng.random() < 0.67 else rng.uniform(0, 2 * np.pi)
    half_width = rng.uniform(3.2, 4.5)
    wall = rng.uniform(0.15, 0.6, (2, NUM_PLOTS, 1)) * rng.uniform(0.75, 1.0, (2, NUM_PLOTS, 3))
    is_green = (rng.random((2, NUM_PLOTS)) < rng.uniform(0.25, 0.8)).astype(float)
    leaf = np.array([0.10, 0.15, 0.05]) * rng.uniform(0.5, 1.1, (2, NUM_PLOTS, 1))
    height = np.where(is_green > 0.5, rng.uniform(1.0, 9.0, (2, NUM_PLOTS)), rng.uniform(4.0, 11.0, (2, NUM_PLOTS)))
    return Street(
        ground_y=ground_y,
        heading_rad=float(heading),
        lane=float(rng.uniform(-0.7, 0.7) * half_width),
        half_width=float(half_width),
        row_distance=(float(rng.uniform(7, 14)), float(rng.uniform(7, 14))),
        asphalt=rng.uniform(0.07, 0.22) * rng.uniform(0.95, 1.05, 3),
        pavement=rng.uniform(0.2, 0.4) * rng.uniform(0.92, 1.05, 3),
        wall=np.where(is_green[..., None] > 0.5, leaf, wall),
        height=height,
        is_green=is_green,
        noise=tileable_noise(rng).astype(np.float32),
    )


def tileable_noise(rng: np.random.Generator) -> Float[np.ndarray, "256 256"]:
    """Noise with details of 1, 4 and 16 samples, spread over [0, 1]."""
    total = np.zeros((256, 256))
    for step, weight in ((1, 0.5), (4, 0.3), (16, 0.2)):
        coarse = rng.random((256 // step, 256 // step))
        total += weight * zoom(coarse, step, order=1, mode="grid-wrap", grid_mode=True)
    low, high = np.quantile(total, [0.01, 0.99])
    return np.clip((total - low) / (high - low), 0, 1)


def ambient(street: Street, light: Light, directions: Directions) -> Colours:
    """Coarse radiance from all around, for diffuse light: sky, a belt of houses, sunlit ground."""
    up = -directions[:, 1:2]
    sky = light.sky(directions)
    level = (light.zenith + light.horizon) / 2 * np.pi / 2
    sun_on_ground = light.sun * max(-light.to_sun[1], 0)
    ground = street.asphalt * (level * 1.4 + sun_on_ground) / np.pi
    belt = street.wall.mean(axis=(0, 1)) * (level + 0.3 * light.sun) / np.pi
    above = np.clip((up - 0.15) / 0.2, 0, 1)
    radiance = np.where(up < 0, ground, belt * (1 - above) + sky * above)
    return radiance.astype(np.float32)
