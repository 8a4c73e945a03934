"""How well a new colour follows, and what else it changes: CIEDE2000 over a car's own pictures, and a strip of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from skimage.color import deltaE_ciede2000, rgb2lab
from torch import Tensor

from carstudio.fitting.car_file import Car
from carstudio.images import to_uint8
from carstudio.models.interface import CategoryModel
from carstudio.scene.paint import body_colour, paint_share, painted, to_srgb
from carstudio.scene.recolour import CarPictures, Colour, PaintConfig, pictures_of

_PAINT, _NO_PAINT = 0.6, 0.1  # shares of paint from which and up to which a pixel counts as one or the other


@dataclass(frozen=True)
class RecolourScore:
    """Mean CIEDE2000 (1 is just visible): paint to what was asked for, after and before; all else to what it was.

    `is_same_shape`: opacity and depth of all pictures are equal to the bit.
    """

    paint_error: float
    paint_error_before: float
    rest_error: float
    is_same_shape: bool


@dataclass(frozen=True)
class RecolourTruth:
    """A car's own pictures, how much of each pixel is paint, and the pictures with the paint exchanged."""

    pictures: CarPictures
    share: Float[Tensor, " pixel"]
    wanted: Float[Tensor, "pixel 3"]


def recolour_truth(model: CategoryModel, car: Car, colour: Colour, config: PaintConfig) -> RecolourTruth:
    """What a perfect recolouring would show; shading of the old paint is kept."""
    pictures = pictures_of(model, car, config)
    paint = body_colour(pictures.pixels)
    share = paint_share(pictures.pixels, paint)
    return RecolourTruth(pictures, share, painted(pictures.pixels.rgb, share, paint, colour))


def own_colour(model: CategoryModel, car: Car, config: PaintConfig) -> Colour:
    """The sRGB colour of a car's paint."""
    red, green, blue = to_srgb(body_colour(pictures_of(model, car, config).pixels)).tolist()
    return red, green, blue


def score_recolour(truth: RecolourTruth, new: CarPictures) -> RecolourScore:
    """Compare a recoloured car's pictures with the truth."""
    old, is_car = truth.pictures.pixels, truth.pictures.pixels.is_car
    is_paint, is_rest = is_car & (truth.share > _PAINT), is_car & (truth.share < _NO_PAINT)
    same = torch.equal(new.opacity, truth.pictures.opacity) and torch.equal(new.pixels.place, old.place)
    return RecolourScore(
        paint_error=difference(new.pixels.rgb[is_paint], truth.wanted[is_paint]),
        paint_error_before=difference(old.rgb[is_paint], truth.wanted[is_paint]),
        rest_error=difference(new.pixels.rgb[is_rest], old.rgb[is_rest]),
        is_same_shape=same,
    )


def difference(a: Float[Tensor, "pixel 3"], b: Float[Tensor, "pixel 3"]) -> float:
    """Mean CIEDE2000 of two lists of sRGB colours; 0 for empty ones."""
    if not len(a):
        return 0.0
    return round(float(deltaE_ciede2000(rgb2lab(a.double().numpy()), rgb2lab(b.double().numpy())).mean()), 3)


def strip(
    pictures: Sequence[CarPictures], wanted: RecolourTruth, config: PaintConfig, rows: Sequence[int] = (1, 3, 6)
) -> UInt8[np.ndarray, "height width 3"]:
    """Side by side: the car, what was asked for, then each way; one row per view, on white."""
    opacity = wanted.pictures.opacity
    columns = [(wanted.pictures.pixels.rgb, opacity), (wanted.wanted, opacity)]
    columns += [(each.pixels.rgb, each.opacity) for each in pictures]
    side = config.side_px
    tiles = []
    for rgb, alpha in columns:
        solid = alpha.view(config.views, side, side, 1)
        image = rgb.view(config.views, side, side, 3) * solid + 1 - solid
        tiles.append(np.concatenate([to_uint8(image[row].numpy()) for row in rows if row < config.views], axis=0))
    return np.concatenate(tiles, axis=1)
