"""Gaussians as ellipses in the image: `projection` with a denominator of 1, right where they are small beside z."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from carstudio.rendering.gaussians.projection import Projected
from carstudio.rendering.gaussians.reference import MAX_ALPHA


@dataclass(frozen=True)
class Ellipses:
    """Gaussians in an image, those alone that can be seen: a column each.

    Rows: u and v of the middle (px); the form's uu, uv and vv (px^-2); the squared distance at which the faintest alpha
    that counts is reached; half width and half height (px) of the ellipse up to there; log of the opacity; depth (m) of
    the middle, and how the depth at which a ray's response peaks changes along u and v (m / px); r, g, b.
    """

    table: Float[np.ndarray, "15 splat"]


def ellipses_of(seen: Projected) -> Ellipses:
    """The ellipses of a projected cloud."""
    uu, uv, vv = seen.uu, seen.uv, seen.vv
    opacity = np.minimum(seen.opacity, MAX_ALPHA)
    limit = seen.limit
    spread = np.sqrt(np.maximum(limit, 0) / np.maximum(uu * vv - uv * uv, 1e-20))
    rows = (
        *(seen.u, seen.v, uu, uv, vv, limit, spread * np.sqrt(vv), spread * np.sqrt(uu)),
        *(np.log(np.maximum(opacity, 1e-12)), seen.depth, -seen.depth * seen.g_u, -seen.depth * seen.g_v, *seen.rgb.T),
    )
    table = np.empty((len(rows), len(opacity)), np.float32)
    for into, values in zip(table, rows, strict=True):
        into[:] = values
    return Ellipses(table if seen.is_seen.all() else np.ascontiguousarray(table[:, seen.is_seen]))
