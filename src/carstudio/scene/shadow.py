"""The contact shadow: how much of the sky a car takes from the ground under and beside it.

The box's bottom rectangle, blurred by a Gaussian whose width is the height of what shades, in closed form: a product of
differences of error functions, so it is smooth, has no samples and does not flicker.
"""

import math

import numpy as np
import torch
from jaxtyping import Float

from carstudio.geometry.camera import Camera
from carstudio.scene.footprint import SHADOW_REACH_M, GroundRectangle, flat_mask
from carstudio.scene.ground import Ground, unproject_pixels

SOFTNESS_M = SHADOW_REACH_M / 3  # standard deviation: a car's sills and bumpers are 0.2 to 0.3 m above the ground
DARKEST = 0.85  # share of the light that the middle of a car's underside takes; the rest comes in from the sides
_FLOATS_M = 0.3  # a car this far above the ground has a shadow 1 / e as dark


def contact_shadow(
    rectangle: GroundRectangle, ground: Ground, camera: Camera, *, darkest: float = DARKEST
) -> Float[np.ndarray, "height width"]:
    """Share of the ground's light that the car takes, for each pixel as if the ground were seen in it; 0 above it."""
    depth = ground.depth(camera)
    shade = np.zeros(depth.shape)
    near = flat_mask(rectangle.grown(SHADOW_REACH_M), camera)
    rows, columns = np.nonzero(near & np.isfinite(depth) & (depth > 0))
    points = unproject_pixels(camera, rows, columns, depth[rows, columns]) - rectangle.center
    along = _blurred_slab(points @ rectangle.along, rectangle.half_m[0])
    across = _blurred_slab(points @ rectangle.across, rectangle.half_m[1])
    shade[rows, columns] = darkest * math.exp(-max(rectangle.gap_m, 0.0) / _FLOATS_M) * along * across
    return shade


def _blurred_slab(x: Float[np.ndarray, " n"], half_m: float) -> Float[np.ndarray, " n"]:
    """1 between -half and half, convolved with the Gaussian; exactly 0 beyond its reach."""
    scale = SOFTNESS_M * math.sqrt(2)
    ends = torch.from_numpy(np.stack([(x + half_m) / scale, (x - half_m) / scale]))
    upper, lower = torch.erf(ends).numpy()
    return np.where(np.abs(x) < half_m + SHADOW_REACH_M, (upper - lower) / 2, 0.0)
