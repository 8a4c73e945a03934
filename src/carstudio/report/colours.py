"""Numbers as colours: opacity in Turbo, depth from near (bright) to far (dark). And the colours of our drawings."""

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8

from carstudio.images import to_uint8

Colour = tuple[int, int, int]  # RGB, 0-255

ORANGE: Colour = (255, 138, 31)  # a car's front
CYAN: Colour = (40, 200, 255)  # the rest of its box
PINK: Colour = (255, 61, 154)  # a 2-D box
GREEN: Colour = (46, 213, 115)  # car pixels
GREY: Colour = (150, 156, 166)  # unknown pixels
NO_DEPTH: Colour = (24, 26, 31)  # pixels without depth


def turbo(values: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """[0, 1] in Google's Turbo colours (0 dark blue, 0.5 green, 1 dark red); values outside are clipped, NaN is 0."""
    return to_uint8(matplotlib.colormaps["turbo"](np.clip(np.nan_to_num(values), 0.0, 1.0))[..., :3])


def colour_depth(
    depth_m: Float[np.ndarray, "height width"], *, near_m: float | None = None, far_m: float | None = None
) -> UInt8[np.ndarray, "height width 3"]:
    """Depth in Viridis, near bright yellow and far dark blue; pixels without depth (NaN, <= 0) are almost black.

    Without a range the 2nd and 98th percentile of this image's depth are its ends.
    """
    seen = np.isfinite(depth_m) & (depth_m > 0)
    picture = np.full((*depth_m.shape, 3), NO_DEPTH, np.uint8)
    if not seen.any():
        return picture
    near, far = np.percentile(depth_m[seen], [2, 98])
    near, far = float(near) if near_m is None else near_m, float(far) if far_m is None else far_m
    share = np.clip((far - depth_m[seen]) / max(far - near, 1e-6), 0.0, 1.0)
    picture[seen] = to_uint8(matplotlib.colormaps["viridis"](share)[..., :3])
    return picture
