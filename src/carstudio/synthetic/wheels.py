"""Wheels: a tyre turned from its profile and a rim disc with painted spokes."""

import numpy as np
from jaxtyping import Float, UInt8

from carstudio.synthetic.body import axles, half_width_at
from carstudio.synthetic.materials import Finish
from carstudio.synthetic.styles import Style
from carstudio.synthetic.surfaces import Part, grid_part

SEGMENTS = 48
TYRE_WIDTH_M = 0.215  # 205 to 225 mm are the most sold widths


def wheel_parts(style: Style, rng: np.random.Generator) -> list[Part]:
    """Four wheels; the rim's design is the car's own."""
    num_spokes, share = int(rng.choice([5, 6, 7, 10])), float(rng.uniform(0.40, 0.62))
    rim_share = float(rng.uniform(0.66, 0.74))
    tyre, rim = _tyre(style.wheel_radius, rim_share), _rim(style.wheel_radius * rim_share, num_spokes, share)
    parts = []
    for axle in axles(style):
        z = half_width_at(style, axle, 0.3) - 0.012
        for piece in (tyre, rim):
            left = piece.moved(axle, style.wheel_radius, z)
            parts += [left, left.mirrored()]
    return parts


def _turned(profile: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "n k 3"]:
    """The surface of (radius, z) points turned about the z axis."""
    angle = np.linspace(0, 2 * np.pi, SEGMENTS + 1)[:, None]
    radius, z = profile[:, 0], profile[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(z, (SEGMENTS + 1, len(z)))], -1)


def _tyre(radius: float, rim_share: float) -> Part:
    rim, w = radius * rim_share, TYRE_WIDTH_M
    bulge, edge = radius - 0.035, radius
    profile = np.array(
        [
            (rim, -0.02), (rim + 0.012, -0.004), ((rim + bulge) / 2, 0.0), (bulge, -0.008), (radius - 0.01, -0.02),
            (edge, -0.045), (edge, -w + 0.045), (radius - 0.012, -w + 0.02), (bulge, -w), (rim, -w + 0.02),
        ]
    )  # fmt: skip
    points = _turned(profile)
    axis = np.array([0.0, 0.0, -w / 2])
    return grid_part(points, outside=points - axis, material=Finish.TYRE)


def _rim(radius: float, num_spokes: int, share: float) -> Part:
    """A disc, deepest between hub and edge."""
    rings = np.array([1.0, 0.95, 0.88, 0.7, 0.45, 0.22, 0.12, 0.0])
    depth = np.array([-0.012, -0.014, -0.035, -0.045, -0.032, -0.02, -0.018, -0.018])
    points = _turned(np.stack([rings * radius, depth], -1))

    def paint(texels: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns"]:
        distance = np.hypot(texels[..., 0], texels[..., 1]) / radius
        angle = np.arctan2(texels[..., 1], texels[..., 0])
        turn = (angle / (2 * np.pi) * num_spokes) % 1
        is_spoke = (np.abs(turn - 0.5) < share / 2) | (distance > 0.88) | (distance < 0.24)
        finish = np.where(is_spoke, int(Finish.RIM), int(Finish.RIM_DARK)).astype(np.uint8)
        finish[distance < 0.09] = Finish.TRIM
        return finish

    return grid_part(points, outside=np.array([0.0, 0.0, 1.0]), painter=paint, texels=(256, 32))
