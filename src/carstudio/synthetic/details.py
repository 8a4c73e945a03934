"""Small parts set onto the body: mirrors and roof rails."""

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.body import half_width_at
from carstudio.synthetic.cabin import cabin_points
from carstudio.synthetic.materials import Finish
from carstudio.synthetic.outline import shoulder_line, station
from carstudio.synthetic.styles import Style
from carstudio.synthetic.surfaces import Part, both_sides, grid_part

MIRROR_OVERHANG_M = 0.04  # beyond the body's widest point


def detail_parts(style: Style, rng: np.random.Generator) -> list[Part]:
    """Mirrors always; roof rails on estates and SUVs, sometimes."""
    finish = Finish.TRIM if style.cladding or rng.random() < 0.25 else Finish.PAINT
    parts = _mirror(style, finish)
    if style.name in ("estate", "suv") and rng.random() < 0.7:
        parts.append(_roof_rail(style, Finish.CHROME if rng.random() < 0.5 else Finish.TRIM))
    return [part for half in parts for part in both_sides(half)]


def rounded_box(
    center: Float[np.ndarray, "3"], half: Float[np.ndarray, "3"], finish: int, exponent: float = 3.5
) -> Part:
    """A super-ellipsoid: a box with round edges."""
    theta, phi = np.meshgrid(np.linspace(0, 2 * np.pi, 21), np.linspace(-np.pi / 2, np.pi / 2, 13), indexing="ij")

    def power(value: Float[np.ndarray, "a b"]) -> Float[np.ndarray, "a b"]:
        return np.sign(value) * np.abs(value) ** (2 / exponent)

    unit = np.stack(
        [power(np.cos(phi)) * power(np.cos(theta)), power(np.sin(phi)), power(np.cos(phi)) * power(np.sin(theta))], -1
    )
    points = center + unit * half
    return grid_part(points, outside=points - center, material=finish)


def _mirror(style: Style, finish: int) -> list[Part]:
    x = station(style, style.cowl) - (0.34 if style.name == "van" else 0.42)
    h = float(shoulder_line(style)(x)) + 0.095
    outer = half_width_at(style, x, 0.45) + MIRROR_OVERHANG_M
    half = np.array([0.055, 0.068, 0.095])
    center = np.array([x, h, outer - half[2]])
    shell = rounded_box(center, half, finish)
    glass = rounded_box(center + np.array([-0.045, 0.0, 0.0]), half * np.array([0.3, 0.8, 0.85]), Finish.GLASS)
    foot = rounded_box(center + np.array([0.0, -0.055, -0.10]), np.array([0.04, 0.03, 0.09]), Finish.TRIM)
    return [shell, glass, foot]


def _roof_rail(style: Style, finish: int) -> Part:
    ring = cabin_points(style, np.array([0.97]))[:, 0]
    front, rear = station(style, style.header + 0.05), station(style, style.roof_end - 0.03)
    order = np.argsort(ring[:, 0])
    x = np.linspace(front, rear, 16)
    h, z = (np.interp(x, ring[order, 0], ring[order, i]) for i in (1, 2))
    angle = np.linspace(0, 2 * np.pi, 9)
    lift = 0.035 * np.sin(np.linspace(0, np.pi, 16)) ** 0.25
    points = np.stack(
        [
            np.repeat(x[:, None], 9, 1),
            (h + lift)[:, None] + 0.016 * np.sin(angle),
            (z - 0.01)[:, None] + 0.016 * np.cos(angle),
        ],
        -1,
    )
    middle = np.stack([x, h + lift, z - 0.01], -1)[:, None]
    return grid_part(points, outside=points - middle, material=finish)
