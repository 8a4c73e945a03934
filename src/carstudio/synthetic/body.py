"""The lower body: a wall of rounded rings from sill to shoulder with wheel arches cut in, bonnet and boot on top.

Design frame (see surfaces). Only the left half is built; the right one is its mirror image.
"""

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.body_paint import deck_painter, wall_painter
from carstudio.synthetic.materials import Finish
from carstudio.synthetic.outline import half_outline, shoulder_line, station
from carstudio.synthetic.styles import Style
from carstudio.synthetic.surfaces import Part, both_sides, grid_part

RINGS = 170  # points along half an outline: about 3.5 cm apart
ROWS = 30  # rings from sill to shoulder
BED_DEPTH_M = 0.48
BED_RAIL_M = 0.09


def arch_radius(style: Style) -> float:
    """Radius of the wheel arches, m."""
    return style.wheel_radius + (0.075 if style.cladding else 0.055)


def axles(style: Style) -> tuple[float, float]:
    """Positions x of front and rear axle."""
    return station(style, style.front_axle), station(style, style.rear_axle)


def width_profile(share: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Half width at a share of the wall's height, relative to the greatest: tucked in below, rounded over on top."""
    tuck = 0.055 * np.clip((0.45 - share) / 0.45, 0, 1) ** 1.6
    lean = 0.035 * np.clip((share - 0.45) / 0.45, 0, 1) ** 1.5
    crease = 0.010 * np.exp(-(((share - 0.66) / 0.05) ** 2))
    roll = np.clip((share - 0.90) / 0.10, 0, 1)
    return 1 - tuck - lean + crease - 0.05 * (1 - np.sqrt(1 - roll**2))


def end_profile(share: Float[np.ndarray, "*n"], *, top_m: float, bottom_m: float) -> Float[np.ndarray, "*n"]:
    """How far a bumper stands back behind the car's end at a share of the wall's height, m."""
    above = np.clip((share - 0.42) / 0.58, 0, 1)
    below = np.clip((0.25 - share) / 0.25, 0, 1)
    step = 0.035 / (1 + np.exp(-(share - 0.55) / 0.02))  # the bumper's upper edge
    return step + (top_m - 0.035) * above**2.0 + bottom_m * below**1.7


def wall_points(style: Style, share: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "n rows 3"]:
    """Points of the wall at shares 0 (sill) to 1 (shoulder) of its height."""
    length, _, width = style.size
    outline = half_outline(
        RINGS, front_exponent=style.corner + 0.4, rear_exponent=style.corner + 1.4, aspect=length / width
    )
    nose = 0.06 if style.bed else 0.14 if style.name in ("van", "suv") else 0.19
    tail = 0.05 if style.bed else 0.06 if style.name in ("van", "suv", "hatchback", "estate") else 0.12
    front = length / 2 - end_profile(share, top_m=nose, bottom_m=0.07)
    rear = length / 2 - end_profile(share, top_m=tail, bottom_m=0.09)
    along = outline.along[:, None]
    x = np.where(along > 0, along * front, along * rear)
    z = outline.across[:, None] * width / 2 * width_profile(share)
    overhang = 0.07 * np.clip(np.abs(along) - 0.72, 0, 1) / 0.28
    low = style.clearance + overhang
    top = shoulder_line(style)(x)
    return np.stack([x, low + (top - low) * share, z], axis=-1)


def snap_to_arches(points: Float[np.ndarray, "n rows 3"], style: Style) -> Float[np.ndarray, "n rows 3"]:
    """Move grid points near an arch onto its circle (in side view), so that the cut edge is round."""
    radius, reach = arch_radius(style), 0.022
    points = points.copy()
    is_side = points[..., 2] > 0.3 * style.size[2]
    for axle in axles(style):
        offset = points[..., :2] - np.array([axle, style.wheel_radius])
        distance = np.linalg.norm(offset, axis=-1)
        near = is_side & (np.abs(distance - radius) < reach)
        points[near, :2] += (offset * (radius / np.maximum(distance, 1e-9) - 1)[..., None])[near]
    return points


def cut_arches(part: Part, style: Style) -> Part:
    """Without the faces inside the arches."""
    centre = part.centroids
    is_cut = np.zeros(len(centre), bool)
    for axle in axles(style):
        distance = np.hypot(centre[:, 0] - axle, centre[:, 1] - style.wheel_radius)
        is_cut |= (distance < arch_radius(style) - 0.004) & (centre[:, 2] > style.size[2] / 2 - 0.36)
    return part.without(is_cut)


def deck_points(style: Style, ring: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n columns 3"]:
    """Bonnet, cowl and boot: straight lines across from the shoulder to the middle plane, slightly domed."""
    half_width = style.size[2] / 2
    if style.bed:
        rail = 1 - BED_RAIL_M / half_width
        across = np.array([1.0, (1 + rail) / 2, rail, rail - 0.012, 0.7, 0.5, 0.3, 0.15, 0.0])
    else:
        across = np.array([1.0, 0.985, 0.96, 0.93, 0.88, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0])
    x = np.repeat(ring[:, :1], len(across), axis=1)
    z = ring[:, 2:] * across
    dome = 0.055 * (1 - across**2) ** 0.8 * (ring[:, 2:] / half_width) ** 2
    ridge = 0.012 * np.exp(-(((across - 0.62) / 0.07) ** 2)) * (ring[:, :1] > 0)
    h = ring[:, 1:2] + dome + ridge
    if style.bed:
        front, rear = station(style, style.backlight) - 0.05, station(style, 1.0) + 0.07
        is_bed = (x < front) & (x > rear) & (z < half_width - BED_RAIL_M - 0.005)
        h = np.where(is_bed, ring[:, 1:2] - BED_DEPTH_M, np.where(x < front, ring[:, 1:2], h))
    return np.stack([x, h, z], axis=-1)


def floor_points(ring: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n columns 3"]:
    """The underside: level lines across from the sill to the middle plane."""
    across = np.array([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.25, 0.0])
    x, h = (np.repeat(ring[:, i : i + 1], len(across), axis=1) for i in (0, 1))
    return np.stack([x, h, ring[:, 2:] * across], axis=-1)


def wheel_wells(style: Style) -> list[Part]:
    """Dark half-tubes behind the arches of the left side, closed towards the car's middle."""
    radius = arch_radius(style)
    angle = np.linspace(-0.35, np.pi + 0.35, 28)
    parts = []
    for axle in axles(style):
        outer = half_width_at(style, axle) - 0.012
        inner = style.size[2] / 2 - 0.36
        ring = np.stack([axle + radius * np.cos(angle), style.wheel_radius + radius * np.sin(angle)], -1)
        tube = np.stack([np.column_stack([ring, np.full(len(ring), z)]) for z in (outer, inner)], axis=1)
        middle = np.array([axle, style.wheel_radius, inner])
        lid = np.stack([tube[:, 1], np.broadcast_to(middle, tube[:, 1].shape)], axis=1)
        left = np.array([0.0, 0.0, 1.0])
        towards_axle = middle - tube
        parts.append(grid_part(tube, outside=towards_axle, material=Finish.UNDERBODY))
        parts.append(grid_part(lid, outside=left, material=Finish.UNDERBODY))
    return parts


def half_width_at(style: Style, x: float, share: float = 0.45) -> float:
    """Half width of the wall at x, at a share of its height."""
    points = wall_points(style, np.array([share]))[:, 0]
    order = np.argsort(points[:, 0])
    return float(np.interp(x, points[order, 0], points[order, 2]))


def body_parts(style: Style) -> list[Part]:
    """Wall, deck, floor and wheel wells, both sides."""
    share = np.concatenate([np.linspace(0, 0.9, ROWS - 6), 0.9 + 0.1 * np.sin(np.linspace(0, np.pi / 2, 7)[1:])])
    points = wall_points(style, share)
    wall = grid_part(snap_to_arches(points, style), painter=wall_painter(style), texels=(1024, 288), seam_z=True)
    deck = grid_part(
        deck_points(style, points[:, -1]),
        outside=np.array([0.0, 1.0, 0.0]),
        painter=deck_painter(style),
        texels=(512, 64),
    )
    floor = grid_part(floor_points(points[:, 0]), outside=np.array([0.0, -1.0, 0.0]), material=Finish.UNDERBODY)
    halves = [cut_arches(wall, style), deck, cut_arches(floor, style), *wheel_wells(style)]
    return [part for half in halves for part in both_sides(half)]
