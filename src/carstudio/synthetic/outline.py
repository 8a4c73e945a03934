"""The curves a car is drawn with: plan-view outline (a rounded super-ellipse) and smooth height lines along the car.

Design frame (see surfaces): x to the front with 0 at the car's middle, h up from the ground, z to the left, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from carstudio.synthetic.styles import Style


@dataclass(frozen=True)
class HalfOutline:
    """Points of the left half of a plan outline as shares of half length and half width: `along` from 1 (front centre)
    to -1 (rear centre), `across` from 0 to 1 and back; evenly spaced on the outline.
    """

    along: Float[np.ndarray, " n"]
    across: Float[np.ndarray, " n"]


def half_outline(num: int, *, front_exponent: float, rear_exponent: float, aspect: float) -> HalfOutline:
    """Super-ellipse |along|^p + |across|^p = 1 with one exponent for each end; `aspect` is length / width."""
    angle = np.linspace(0, np.pi, 20_001)
    exponent = np.where(angle <= np.pi / 2, front_exponent, rear_exponent)
    along = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** (2 / exponent)
    across = np.abs(np.sin(angle)) ** (2 / exponent)
    along[0], along[-1], across[0], across[-1] = 1, -1, 0, 0
    length = np.concatenate([[0], np.cumsum(np.hypot(np.diff(along) * aspect, np.diff(across)))])
    at = np.interp(np.linspace(0, length[-1], num), length, np.arange(len(angle)))
    return HalfOutline(np.interp(at, np.arange(len(angle)), along), np.interp(at, np.arange(len(angle)), across))


def height_line(style: Style, knots: Sequence[tuple[float, float]]) -> PchipInterpolator:
    """Smooth monotone-between-knots curve h(x); knots are (share of the length from the front, height in m)."""
    length = style.size[0]
    position = np.array([length * (0.5 - share) for share, _ in knots])
    height = np.array([h for _, h in knots])
    order = np.argsort(position)
    return PchipInterpolator(position[order], height[order], extrapolate=True)


def station(style: Style, share: float) -> float:
    """Position x of a share of the length from the front bumper."""
    return style.size[0] * (0.5 - share)


def shoulder_line(style: Style) -> PchipInterpolator:
    """Upper edge of the lower body: bonnet, belt line, boot."""
    height = style.size[1]
    middle = (style.cowl + style.backlight) / 2
    return height_line(
        style,
        [
            (-0.02, style.nose_height * height - 0.01),
            (0.04, style.nose_height * height + 0.02),
            (style.cowl - 0.01, style.cowl_height * height - 0.01),
            (middle, style.belt_height * height + 0.015),
            (min(style.backlight, 0.94), style.tail_height * height),
            (1.02, style.tail_height * height - 0.015),
        ],
    )


def roof_line(style: Style) -> PchipInterpolator:
    """The roof's centre line."""
    height = style.size[1]
    peak = style.header + 0.3 * (style.roof_end - style.header)
    return height_line(
        style,
        [
            (style.header - 0.03, height - 0.045),
            (style.header + 0.02, height - 0.018),
            (peak, height),
            (style.roof_end + 0.01, height - style.roof_drop),
            (style.roof_end + 0.12, height - style.roof_drop - 0.05),
        ],
    )
