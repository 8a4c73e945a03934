"""What is painted on the body's charts: windows and pillars, lamps, grille, plates, door gaps, handles.

A painter gets the position (x, h, z; metres, design frame, z >= 0) of every texel and returns its finish.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8

from carstudio.synthetic.materials import Finish
from carstudio.synthetic.outline import roof_line, shoulder_line, station
from carstudio.synthetic.styles import Style
from carstudio.synthetic.surfaces import Painter

Mask = Bool[np.ndarray, "rows columns"]
Points = Float[np.ndarray, "rows columns 3"]
GAP_M = 0.013  # drawn width of a door gap: real ones are 4 mm, but look wider by their rounded edges


def wall_painter(style: Style) -> Painter:
    """Everything below the shoulder."""

    def paint(points: Points) -> UInt8[np.ndarray, "rows columns"]:
        finish = np.full(points.shape[:2], int(Finish.PAINT), np.uint8)
        depth = np.asarray(shoulder_line(style)(points[..., 0])) - points[..., 1]
        _paint_sides(finish, points, depth, style)
        _paint_front(finish, points, depth, style)
        _paint_rear(finish, points, depth, style)
        return finish

    return paint


def _line(value: Float[np.ndarray, "rows columns"], at: float, width: float = GAP_M) -> Mask:
    return np.abs(value - at) < width / 2


def _paint_sides(finish: UInt8[np.ndarray, "rows columns"], points: Points, depth: np.ndarray, style: Style) -> None:
    x, h, z = np.moveaxis(points, -1, 0)
    length, _, width = style.size
    is_side = z > 0.36 * width
    sill = style.clearance + (0.13 if style.cladding else 0.05)
    axles = [station(style, style.front_axle), station(style, style.rear_axle)]
    arch = np.min([np.hypot(x - axle, h - style.wheel_radius) for axle in axles], axis=0)
    between = (x < axles[0]) & (x > axles[1])
    for position in style.doors:
        gap = _line(x, station(style, position)) & (h > sill + 0.04)
        finish[is_side & gap & (arch > style.wheel_radius + 0.10)] = Finish.GAP
    front_door, rear_door = station(style, style.doors[0]), station(style, style.doors[-1])
    is_door = (x < front_door) & (x > rear_door)
    finish[is_side & is_door & _line(h, sill + 0.045)] = Finish.GAP
    finish[is_side & between & (h < sill)] = Finish.TRIM
    if style.cladding:
        finish[is_side & (arch < style.wheel_radius + 0.135)] = Finish.TRIM
        finish[(h < sill + 0.02) & (np.abs(x) > 0.3 * length)] = Finish.TRIM
    for position in style.doors[1:]:
        start = station(style, position) + 0.045
        finish[is_side & (x > start) & (x < start + 0.19) & (depth > 0.115) & (depth < 0.15)] = Finish.GLOSS_BLACK
        finish[is_side & (x > start) & (x < start + 0.19) & (depth > 0.115) & (depth < 0.133)] = Finish.CHROME
    belt = is_side & (x < station(style, style.cowl) - 0.1) & (x > station(style, style.glass_end))
    finish[belt & (depth < 0.012)] = Finish.TRIM


def _paint_front(finish: UInt8[np.ndarray, "rows columns"], points: Points, depth: np.ndarray, style: Style) -> None:
    x, h, z = np.moveaxis(points, -1, 0)
    length, _, width = style.size
    back = length / 2 - x
    half = width / 2
    is_front = back < 0.75
    top = np.asarray(0.045 + 0.02 * (1 - z / half))
    lamp = is_front & (z > 0.50 * half) & (back < 0.52 * style.lamp_scale) & (depth > top)
    lamp &= depth < style.lamp_scale * (0.225 - 0.17 * back)
    grille_low = 0.24 if style.name in ("van", "pickup", "suv") else 0.20
    grille = is_front & (back < 0.40) & (z < style.grille_width * half) & (depth > 0.06) & (depth < grille_low)
    finish[grille] = Finish.GLOSS_BLACK
    if style.has_chrome_grille:
        finish[grille & ((depth - 0.06) % 0.055 < 0.014)] = Finish.CHROME
        finish[grille & ((depth < 0.078) | (z > (style.grille_width - 0.02) * half))] = Finish.CHROME
    else:
        finish[grille & (np.hypot(depth - 0.12, z) < 0.045)] = Finish.CHROME  # the maker's badge
    intake = is_front & (h < style.clearance + 0.19) & (h > style.clearance + 0.09) & (z < 0.72 * half - 0.5 * back)
    finish[intake & (back < 0.35)] = Finish.TRIM
    finish[is_front & (back < 0.6) & (h < style.clearance + 0.085)] = Finish.TRIM
    fog = (np.hypot(z - 0.72 * half, h - style.clearance - 0.17) < 0.055) & (back < 0.5)
    finish[is_front & fog] = Finish.HEADLAMP
    finish[lamp] = Finish.HEADLAMP
    finish[lamp & (back > 0.36 * style.lamp_scale)] = Finish.INDICATOR
    finish[lamp & ((depth < top + 0.012) | (np.abs(z - 0.52 * half) < 0.012))] = Finish.GLOSS_BLACK
    _paint_plate(finish, is_front & (back < 0.3), z, h - (style.clearance + 0.30), Finish.FRONT_PLATE)


def _paint_rear(finish: UInt8[np.ndarray, "rows columns"], points: Points, depth: np.ndarray, style: Style) -> None:
    x, h, z = np.moveaxis(points, -1, 0)
    length, _, width = style.size
    back, half = x + length / 2, width / 2
    is_rear = back < 0.6
    tall = style.name in ("hatchback", "suv", "estate", "van", "pickup")
    inner, low = (0.66, 0.36) if tall else (0.46, 0.21)
    lamp = is_rear & (z > inner * half) & (back < (0.22 if tall else 0.30)) & (depth > 0.03) & (depth < low)
    lid = 0.62 * half if tall else 0.70 * half
    gap = _line(z, lid) & (depth < 0.42) | (_line(depth, 0.42) & (z < lid))
    finish[is_rear & (back < 0.4) & gap] = Finish.GAP
    finish[is_rear & (back < 0.7) & (h < style.clearance + 0.13)] = Finish.TRIM
    finish[is_rear & (back < 0.3) & _line(depth, 0.16, 0.03) & (z < 0.36 * half)] = Finish.CHROME
    finish[lamp] = Finish.TAILLAMP
    middle = 0.62 * low
    is_band = np.abs(depth - middle) < 0.028
    finish[lamp & is_band & (z < 0.90 * half) & (back < 0.2)] = Finish.REVERSE_LAMP
    finish[lamp & (np.abs(depth - middle) >= 0.028) & (np.abs(depth - middle) < 0.036)] = Finish.GLOSS_BLACK
    finish[is_rear & (h < style.clearance + 0.16) & (h > style.clearance + 0.13) & (np.abs(z - 0.70 * half) < 0.07)] = (
        Finish.TAILLAMP
    )
    plate_height = style.clearance + 0.20 if style.name in ("coupe", "pickup") else None
    middle_h = (h - plate_height) if plate_height is not None else 0.27 - depth
    _paint_plate(finish, is_rear & (back < 0.3), z, middle_h, Finish.REAR_PLATE)


def _paint_plate(
    finish: UInt8[np.ndarray, "rows columns"], where: Mask, z: np.ndarray, up: np.ndarray, colour: Finish
) -> None:
    """A 52 x 11 cm plate with letters suggested (they are symmetric: the chart serves both sides)."""
    finish[where & (z < 0.275) & (np.abs(up) < 0.068)] = Finish.TRIM
    finish[where & (z < 0.26) & (np.abs(up) < 0.055)] = colour
    stroke = ((z + 0.005) % 0.062 < 0.036) & (z < 0.215) & (np.abs(up) < 0.032)
    finish[where & stroke] = Finish.LETTERS


def deck_painter(style: Style) -> Painter:
    """Bonnet gaps, cowl, bed."""

    def paint(points: Points) -> UInt8[np.ndarray, "rows columns"]:
        finish = np.full(points.shape[:2], int(Finish.PAINT), np.uint8)
        x, h, z = np.moveaxis(points, -1, 0)
        cowl, half = station(style, style.cowl), style.size[2] / 2
        finish[(x > cowl - 0.02) & (x < style.size[0] / 2 - 0.16) & _line(z, 0.80 * half, 0.016)] = Finish.GAP
        finish[(np.abs(x - cowl - 0.05) < 0.05) & (z < 0.80 * half)] = Finish.TRIM
        finish[_line(x, style.size[0] / 2 - 0.17, 0.016) & (z < 0.80 * half)] = Finish.GAP
        if style.bed:
            depth = np.asarray(shoulder_line(style)(x)) - h
            finish[depth > 0.03] = Finish.TRIM
        elif style.name in ("sedan", "coupe"):
            seat = station(style, style.backlight)
            finish[(x < seat - 0.05) & _line(z, 0.74 * half, 0.016)] = Finish.GAP
        return finish

    return paint


def cabin_painter(style: Style) -> Painter:
    """Windows between painted pillars; dark posts between the side windows."""

    def paint(points: Points) -> UInt8[np.ndarray, "rows columns"]:
        x, z = points[..., 0], points[..., 2]
        finish = np.full(points.shape[:2], int(Finish.PAINT), np.uint8)
        share = _height_share(points, style)
        front, rear, half = x.max(axis=0), x.min(axis=0), z.max(axis=0)
        across, along = z / half, (2 * x - front - rear) / (front - rear)
        is_glass_row = (share > 0.02) & (share < 0.84)
        screen = (along > 0.5) & (across < 0.90) & (share < 0.90)
        finish[screen & (share > -0.2)] = Finish.GLASS
        finish[(along > 0.5) & (across < 0.93) & ~screen & (share < 0.93)] = Finish.GLOSS_BLACK
        rear_low = 0.12 if style.name in ("hatchback", "suv", "estate", "van") else 0.0
        back = (along < -0.5) & (across < 0.86) & (share < 0.86)
        finish[back & (share > rear_low)] = Finish.GLASS
        _paint_side_windows(finish, points, is_glass_row & (across > 0.93), along, style)
        if style.name in ("hatchback", "suv", "estate"):
            finish[(along < -0.5) & (across < 0.35) & (np.abs(share - 0.90) < 0.025)] = Finish.TAILLAMP
        return finish

    return paint


def _height_share(points: Points, style: Style) -> Float[np.ndarray, "rows columns"]:
    """0 at the belt line, 1 at the roof."""
    x, h, _ = np.moveaxis(points, -1, 0)
    low = np.asarray(shoulder_line(style)(x))
    high = np.asarray(roof_line(style)(np.clip(x, station(style, style.roof_end), station(style, style.header))))
    return (h - low) / (high - low)


def _paint_side_windows(
    finish: UInt8[np.ndarray, "rows columns"], points: Points, rows: Mask, along: np.ndarray, style: Style
) -> None:
    x, share = points[..., 0], _height_share(points, style)
    slope = (style.backlight - style.roof_end) * style.size[0]
    end = station(style, style.glass_end) + 0.55 * slope * np.clip(share, 0, 1) * (1 if slope > 0.3 else 0.4)
    window = rows & (along < 0.865) & (x > end)
    finish[window] = Finish.GLASS
    frame = rows & (along < 0.88) & (x > end - 0.03) & ~window
    finish[frame] = Finish.GLOSS_BLACK
    for position in style.pillars:
        finish[window & _line(x, station(style, position) - 0.01, 0.085)] = Finish.GLOSS_BLACK
    finish[window & _line(x, station(style, style.doors[0] + 0.075), 0.025)] = Finish.GLOSS_BLACK
