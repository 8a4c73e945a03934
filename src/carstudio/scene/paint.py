"""What of a car is paint, told from its pictures: where a pixel lies on the car, and whether it has the body's colour.

Glass, lamps, tyres and the underbody are kept out by place, and by colour where the place is not enough. Colours are
compared in linear light: shading scales them and leaves their chromaticity.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from PIL import ImageColor
from torch import Tensor

from carstudio.errors import InputError

_GAMMA = 2.2
# Canonical places (x front, y down, z left; the box is [-1, 1]^3), read off the synthetic cars' outlines.
_AXLES, _WHEEL_X, _WHEEL_Y, _WHEEL_SIDE = (0.62, -0.6), 0.2, 0.5, 0.45
_UNDERBODY = 0.82
_GLASS = (-0.86, -0.08)  # between roof and belt line
_ENDS = 0.85  # lamps and grille
# How far paint strays from its own colour: chromaticity, log of its light; on the body it may stray `_BODY` times that.
_CHROMATICITY, _DARKER, _BRIGHTER, _BODY = 0.15, 0.8, 1.6, 2.5
_DARK_APART = 1.0  # log of lights: glass that differs less from the paint cannot be told from it


@dataclass(frozen=True)
class PaintView:
    """Pixels of a car: colour (sRGB), canonical place, whether they are on the car at all."""

    rgb: Float[Tensor, "pixel 3"]
    place: Float[Tensor, "pixel 3"]
    is_car: Bool[Tensor, " pixel"]


def parse_colour(colour: str | tuple[float, float, float]) -> tuple[float, float, float]:
    """`#c01020`, `red`, or three numbers (0 to 1, or 0 to 255 where one is above 1) as sRGB in [0, 1]."""
    if isinstance(colour, str):
        try:
            values = ImageColor.getrgb(colour)
        except ValueError as error:
            raise InputError(f"colour {colour!r}: expected '#rrggbb', a name such as red, or three numbers") from error
        return values[0] / 255, values[1] / 255, values[2] / 255
    most = 255.0 if max(colour) > 1 else 1.0
    if not (min(colour) >= 0 and max(colour) <= most):
        raise InputError(f"colour {colour}: expected three numbers of 0 to 1, or of 0 to 255")
    return colour[0] / most, colour[1] / most, colour[2] / most


def to_linear(rgb: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """SRGB to linear light, by the plain power law."""
    return rgb.clamp(0, 1) ** _GAMMA


def to_srgb(light: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Linear light to sRGB."""
    return light.clamp(0, 1) ** (1 / _GAMMA)


def light_of(linear: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Luminance (ITU-R BT.709)."""
    return (linear * linear.new_tensor([0.2126, 0.7152, 0.0722])).sum(dim=-1)


def in_wheel(place: Float[Tensor, "pixel 3"]) -> Bool[Tensor, " pixel"]:
    """Where tyres and wheel arches are."""
    x, y, z = place.unbind(-1)
    low = (y - (1 - _WHEEL_Y * 0.86)) / _WHEEL_Y
    near = torch.stack([((x - axle) / _WHEEL_X) ** 2 + low**2 < 1 for axle in _AXLES]).any(dim=0)
    return near & (z.abs() > _WHEEL_SIDE)


def in_glass(place: Float[Tensor, "pixel 3"]) -> Bool[Tensor, " pixel"]:
    """Between roof and belt line."""
    return (place[:, 1] > _GLASS[0]) & (place[:, 1] < _GLASS[1])


def is_body(place: Float[Tensor, "pixel 3"]) -> Bool[Tensor, " pixel"]:
    """Below the windows, above the sills, beside the wheels, away from the lamps: mostly paint."""
    x, y, _ = place.unbind(-1)
    return (y > 0) & (y < 0.5) & (x.abs() < 0.8) & ~in_wheel(place)


def body_colour(view: PaintView) -> Float[Tensor, "3"]:
    """The paint's colour in linear light: the mean of the body's brighter part, where neither dirt nor glints are.

    `InputError` when no body is seen.
    """
    body = view.is_car & is_body(view.place)
    if not bool(body.any()):
        raise InputError("the car's body is not to be seen in its own pictures; it cannot be painted")
    linear = to_linear(view.rgb[body])
    order = light_of(linear).argsort()
    brighter = order[len(order) // 2 : max(len(order) * 9 // 10, len(order) // 2 + 1)]
    return linear[brighter].mean(dim=0).clamp(min=1e-3)


def paint_share(view: PaintView, paint: Float[Tensor, "3"]) -> Float[Tensor, " pixel"]:
    """How much of each pixel is paint, 0 to 1.

    On the body nearly everything is; between roof and belt line and at the ends only what has the paint's colour. Where
    paint without a hue looks like the windows, nothing between roof and belt line is taken: neither light nor hue tells
    the two apart.
    """
    linear = to_linear(view.rgb)
    glass, ends = in_glass(view.place), view.place[:, 0].abs() > _ENDS
    share = torch.where(glass | ends, _likeness(linear, paint, 1.0), _likeness(linear, paint, _BODY))
    seen = view.is_car & glass
    has_hue = float((_chromaticity(paint) - 1 / 3).norm()) > _CHROMATICITY
    if bool(seen.any()) and not has_hue:
        apart = (light_of(linear[seen]).median().clamp(min=1e-3).log() - light_of(paint).log()).abs()
        hue = (_chromaticity(linear[seen]).median(dim=0).values - _chromaticity(paint)).norm()
        if float(apart) < _DARK_APART and float(hue) < _CHROMATICITY:
            share = torch.where(glass, 0.0, share)
    out = in_wheel(view.place) | (view.place[:, 1] > _UNDERBODY) | ~view.is_car
    return torch.where(out, 0.0, share)


def _likeness(linear: Float[Tensor, "pixel 3"], paint: Float[Tensor, "3"], wide: float) -> Float[Tensor, " pixel"]:
    """Near 1 for pixels whose colour is the paint's under more or less light; little colour is left in the dark.

    Paint may be much brighter than itself in the shade (the sun), but hardly much darker.
    """
    light, own = light_of(linear).clamp(min=1e-4), light_of(paint)
    hue = (_chromaticity(linear) - _chromaticity(paint)).norm(dim=-1)
    trust = (light / 0.02).clamp(max=1.0)
    brighter = (light / own).log()
    reach = torch.where(brighter > 0, _BRIGHTER, _DARKER)
    misses = (trust * hue / (wide * _CHROMATICITY)) ** 2 + (brighter / (wide * reach)) ** 2
    return torch.exp(-misses / 2)


def _chromaticity(linear: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
    return linear / linear.sum(dim=-1, keepdim=True).clamp(min=1e-4)


def painted(
    rgb: Float[Tensor, "pixel 3"],
    share: Float[Tensor, " pixel"],
    paint: Float[Tensor, "3"],
    colour: tuple[float, float, float],
) -> Float[Tensor, "pixel 3"]:
    """The pixels with the paint's colour exchanged: shading is kept, glints stay white (sRGB)."""
    linear, new = to_linear(rgb), to_linear(rgb.new_tensor(colour))
    shade = (light_of(linear) / light_of(paint))[:, None]
    glint = (shade - 1.6).clamp(min=0) * light_of(paint)
    changed = to_srgb(shade.clamp(max=1.6) * new + glint)
    return rgb + share[:, None] * (changed - rgb)
