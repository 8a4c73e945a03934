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
_CHROMATICITY, _LOG_LIGHT = 0.05, 0.7  # how far paint strays from its own colour
_DARK_APART = 0.7  # log of lights: glass that differs less from the paint cannot be told from it


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
            levels = ImageColor.getrgb(colour)
        except ValueError as error:
            raise InputError(f"colour {colour!r}: expected '#rrggbb', a name such as red, or three numbers") from error
        return levels[0] / 255, levels[1] / 255, levels[2] / 255
    most = 255.0 if max(colour) > 1 else 1.0
    if min(colour) < 0 or max(colour) > most:
        raise InputError(f"colour {colour}: expected three numbers of 0 to 1, or of 0 to 255")
    red, green, blue = (value / most for value in colour)
    return red, green, blue


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
    """The paint's colour in linear light: the median over the body. `InputError` when no body is seen."""
    body = view.is_car & is_body(view.place)
    if not bool(body.any()):
        raise InputError("the car's body is not to be seen in its own pictures; it cannot be painted")
    return to_linear(view.rgb[body]).median(dim=0).values.clamp(min=1e-3)


def paint_share(view: PaintView, paint: Float[Tensor, "3"]) -> Float[Tensor, " pixel"]:
    """How much of each pixel is paint, 0 to 1."""
    linear = to_linear(view.rgb)
    glass, lamps = in_glass(view.place), view.place[:, 0].abs() > 0.82
    strict = _likeness(linear, paint, 1.0)
    share = torch.where(glass | lamps, strict, _likeness(linear, paint, 2.0))
    seen = view.is_car & glass
    if bool(seen.any()):
        apart = (light_of(linear[seen]).median().clamp(min=1e-3).log() - light_of(paint).log()).abs()
        share = torch.where(glass & (apart < _DARK_APART), 0.0, share)
    out = in_wheel(view.place) | (view.place[:, 1] > _UNDERBODY) | ~view.is_car
    return torch.where(out, 0.0, share)


def _likeness(linear: Float[Tensor, "pixel 3"], paint: Float[Tensor, "3"], wide: float) -> Float[Tensor, " pixel"]:
    """Near 1 for pixels whose colour is the paint's under more or less light; little colour is left in the dark."""
    light, own = light_of(linear).clamp(min=1e-4), light_of(paint)
    hue = (_chromaticity(linear) - _chromaticity(paint)).norm(dim=-1)
    trust = (light / 0.02).clamp(max=1.0)
    misses = (trust * hue / (wide * _CHROMATICITY)) ** 2 + ((light / own).log() / (wide * _LOG_LIGHT)) ** 2
    return torch.exp(-(misses**2) / 2)


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
