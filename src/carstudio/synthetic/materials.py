"""What a car's surfaces are made of: finishes with colour and gloss, paints by how often they are seen.

Colours are linear reflectances (albedo), unless a name says sRGB.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float

RGB = tuple[float, float, float]


class Finish(IntEnum):
    """Index of a surface finish in a car's material table."""

    PAINT = 0
    GLASS = 1
    TRIM = 2  # black plastic
    GLOSS_BLACK = 3  # pillars between windows, grille bars
    CHROME = 4
    HEADLAMP = 5
    INDICATOR = 6
    TAILLAMP = 7
    REVERSE_LAMP = 8
    FRONT_PLATE = 9
    REAR_PLATE = 10
    GAP = 11  # door gaps
    UNDERBODY = 12  # wheel wells, floor
    TYRE = 13
    RIM = 14
    RIM_DARK = 15  # between the spokes
    LETTERS = 16  # on the plates


@dataclass(frozen=True)
class Material:
    """`specular`: Fresnel reflectance at normal incidence; `mirror`: share of it that is a sharp image of the
    surroundings; `metallic`: share of the colour that reflects as metal flakes do instead of diffusely.
    """

    rgb: RGB
    specular: float = 0.04
    mirror: float = 0.0
    metallic: float = 0.0


@dataclass(frozen=True)
class Paint:
    """A body colour: sRGB 0-255, share of cars, metallic or plain."""

    name: str
    srgb: tuple[int, int, int]
    share: float
    metallic: float


# Shares after the yearly colour reports of paint makers for Europe (BASF, Axalta, 2010s: white 28, grey 22, black 20,
# blue 10, silver 9, red 6 %, rest 5), with the saturated ones raised by half so that colour is learned.
PAINTS = (
    Paint("white", (236, 236, 232), 0.20, 0.0),
    Paint("silver", (186, 189, 192), 0.12, 0.5),
    Paint("grey", (104, 107, 111), 0.13, 0.45),
    Paint("black", (22, 22, 24), 0.14, 0.1),
    Paint("blue", (26, 62, 132), 0.09, 0.3),
    Paint("light blue", (82, 138, 190), 0.03, 0.2),
    Paint("navy", (20, 30, 62), 0.04, 0.2),
    Paint("red", (178, 20, 26), 0.10, 0.05),
    Paint("burgundy", (96, 18, 32), 0.02, 0.3),
    Paint("orange", (226, 98, 22), 0.025, 0.1),
    Paint("yellow", (236, 190, 30), 0.02, 0.0),
    Paint("green", (28, 88, 54), 0.03, 0.25),
    Paint("lime", (134, 176, 46), 0.015, 0.1),
    Paint("brown", (88, 66, 50), 0.025, 0.35),
    Paint("beige", (196, 182, 152), 0.025, 0.35),
)


def linear_from_srgb(srgb: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
    """IEC 61966-2-1, values in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(rgb: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 3"]:
    """Inverse of `linear_from_srgb`; negative values become 0."""
    rgb = np.maximum(rgb, 0)
    return np.where(rgb <= 0.0031308, rgb * 12.92, 1.055 * rgb ** (1 / 2.4) - 0.055)


def linear(srgb: tuple[int, int, int]) -> RGB:
    """Linear reflectance of an sRGB colour 0-255."""
    r, g, b = linear_from_srgb(np.array(srgb, float) / 255).tolist()
    return r, g, b


def draw_paint(rng: np.random.Generator) -> Paint:
    """A paint by its share, its colour varied by a few per cent."""
    shares = np.array([paint.share for paint in PAINTS])
    paint = PAINTS[int(rng.choice(len(PAINTS), p=shares / shares.sum()))]
    r, g, b = np.clip(np.array(paint.srgb) * rng.uniform(0.97, 1.03, 3) * rng.uniform(0.93, 1.05), 4, 250).round()
    return Paint(paint.name, (int(r), int(g), int(b)), paint.share, paint.metallic)


def car_materials(paint: Paint, rng: np.random.Generator) -> tuple[Material, ...]:
    """The material table of one car, in the order of `Finish`."""
    trim = float(rng.choice([0.018, 0.03, 0.06]))
    rim = float(rng.choice([0.55, 0.4, 0.12], p=[0.5, 0.35, 0.15]))
    rear_plate = (0.75, 0.55, 0.06) if rng.random() < 0.15 else (0.78, 0.78, 0.76)  # British and Dutch ones are yellow
    table = {
        Finish.PAINT: Material(linear(paint.srgb), 0.045, 1.0, paint.metallic),
        Finish.GLASS: Material((0.012, 0.014, 0.015), 0.06, 1.0),
        Finish.TRIM: Material((trim, trim, trim * 1.05), 0.03, 0.15),
        Finish.GLOSS_BLACK: Material((0.008, 0.008, 0.009), 0.04, 0.6),
        Finish.CHROME: Material((0.62, 0.63, 0.65), 0.5, 0.8, 0.9),
        Finish.HEADLAMP: Material((0.78, 0.80, 0.84), 0.08, 0.8, 0.2),
        Finish.INDICATOR: Material((0.85, 0.30, 0.02), 0.05, 0.6),
        Finish.TAILLAMP: Material((0.55, 0.008, 0.01), 0.05, 0.7),
        Finish.REVERSE_LAMP: Material((0.62, 0.60, 0.60), 0.05, 0.7),
        Finish.FRONT_PLATE: Material((0.78, 0.78, 0.76)),
        Finish.REAR_PLATE: Material(rear_plate),
        Finish.GAP: Material((0.006, 0.006, 0.006), 0.01),
        Finish.UNDERBODY: Material((0.012, 0.012, 0.012), 0.0),
        Finish.TYRE: Material((0.022, 0.022, 0.023), 0.02),
        Finish.RIM: Material((rim, rim, rim * 1.02), 0.2, 0.25, 0.5),
        Finish.RIM_DARK: Material((0.02, 0.02, 0.02), 0.02),
        Finish.LETTERS: Material((0.02, 0.02, 0.03), 0.02),
    }
    return tuple(table[finish] for finish in Finish)
