"""The glasshouse: rings from the belt line up to the roof, leaning inwards, with a domed roof on top.

Design frame (see surfaces); left half built, right half mirrored.
"""

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.body_paint import cabin_painter
from carstudio.synthetic.materials import Finish
from carstudio.synthetic.outline import half_outline, roof_line, shoulder_line, station
from carstudio.synthetic.styles import Style
from carstudio.synthetic.surfaces import Part, both_sides, grid_part

RINGS = 110
SUNK_M = 0.05  # how far the glasshouse reaches into the lower body
ROLL = 0.80  # share of the height above which the sides round over into the roof


def cabin_points(style: Style, share: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "n rows 3"]:
    """Points of the glasshouse at shares 0 (below the belt) to 1 (edge of the roof)."""
    x0, x1 = station(style, style.cowl), station(style, style.backlight)
    top0, top1 = station(style, style.header), station(style, style.roof_end)
    outline = half_outline(RINGS, front_exponent=4.6, rear_exponent=5.5, aspect=(x0 - x1) / style.size[2])
    bow = share + 0.10 * share * (1 - share)  # the glass is curved, not flat
    roll = np.clip((share - ROLL) / (1 - ROLL), 0, 1)
    over = 1 - np.sqrt(1 - roll**2)
    front = x0 + (top0 - x0) * bow - 0.10 * over
    rear = x1 + (top1 - x1) * bow + 0.06 * over
    half = style.size[2] / 2 * 0.905
    width = half - style.tumblehome * (0.8 * share + 0.2 * share**2) - 0.075 * over
    along, across = outline.along[:, None], outline.across[:, None]
    x = (front + rear) / 2 + along * (front - rear) / 2
    base = np.asarray(shoulder_line(style)(x0 + (x1 - x0) * (1 - along) / 2)) - SUNK_M
    roof = np.asarray(roof_line(style)((top0 + top1) / 2 + along * (top0 - top1) / 2)) - roof_dome(style)
    return np.stack([x, base + (roof - base) * (1 - (1 - share) ** 1.08), across * width], axis=-1)


def roof_dome(style: Style) -> float:
    """Height of the roof's middle above its sides, m."""
    return 0.025 + 0.012 * style.size[1]


def roof_points(style: Style, ring: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n columns 3"]:
    """Lines across from the roof's edge to the middle plane, meeting the roof line there."""
    across = np.array([1.0, 0.97, 0.92, 0.85, 0.75, 0.6, 0.4, 0.2, 0.0])
    x = np.repeat(ring[:, :1], len(across), axis=1)
    rise = roof_dome(style) * (ring[:, 2:] / ring[:, 2].max()) ** 2
    return np.stack([x, ring[:, 1:2] + rise * (1 - across**2), ring[:, 2:] * across], axis=-1)


def cabin_parts(style: Style) -> list[Part]:
    """Windows, pillars and roof, both sides."""
    share = np.concatenate([np.linspace(0, ROLL, 13), ROLL + (1 - ROLL) * np.sin(np.linspace(0, np.pi / 2, 7)[1:])])
    points = cabin_points(style, share)
    wall = grid_part(points, painter=cabin_painter(style), texels=(768, 160), seam_z=True)
    roof = grid_part(roof_points(style, points[:, -1]), outside=np.array([0.0, 1.0, 0.0]), material=Finish.PAINT)
    return [part for half in (wall, roof) for part in both_sides(half)]
