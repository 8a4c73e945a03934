"""A picture of Gaussians by its 4 x 4 tiles of pixels: sorted once per tile instead of once per ray.

Every Gaussian is entered in the tiles that it reaches, each tile sorts its own by where they peak along its middle ray,
and all 16 pixels composite them in that order. Where two Gaussians cross within a tile, some of its pixels have them in
the wrong order; nothing is left out. `pinhole` draws the same exactly.
"""

from functools import partial

import numpy as np
from jaxtyping import Float, Int

from carstudio.rendering.gaussians.ellipses import Ellipses
from carstudio.rendering.gaussians.screen_tiles import (
    MONOMIALS,
    PIXELS,
    Band,
    U,
    V,
    composite_in_place,
    draw_by_bands,
    fullest_first,
    pairs_met,
)

_DEPTH_BITS = 20  # of a sort key
_NOTHING = -1e4  # a logarithm whose exponential is 0
_FORM = [2, 3, 4, 8]  # rows of `Ellipses.table`: uu, uv, vv, log of the opacity
_CHANNELS = 7  # depth in the tile's middle, its change along u and v, r, g, b, 1


def draw_ellipses(ellipses: Ellipses, width: int, height: int) -> Float[np.ndarray, "height width 5"]:
    """Premultiplied rgb over black, opacity and depth (m, mean over the weights; 0 where nothing is)."""
    return draw_by_bands(width, height, partial(_draw_band, ellipses))


def _draw_band(ellipses: Ellipses, band: Band) -> None:
    tile, terms, channels = _pairs(ellipses, band)
    for tiles, place in fullest_first(tile):
        weights = _weights(terms, place.T)
        sums = np.matmul(weights.transpose(1, 2, 0), channels.take(place, axis=1).transpose(1, 2, 0))
        depth = sums[..., 0] + sums[..., 1] * U + sums[..., 2] * V
        band.put(tiles, sums[..., 3:], depth / np.maximum(sums[..., 6], 1e-8))


def _weights(
    terms: Float[np.ndarray, "6 pair"], place: Int[np.ndarray, "rank tile"]
) -> Float[np.ndarray, "rank tile pixel"]:
    """alpha_i prod_{j<i} (1 - alpha_j) of each tile's Gaussians, front first, in each of its pixels."""
    weights = terms.take(place.ravel(), axis=1).T @ MONOMIALS
    np.exp(weights, out=weights)
    weights = weights.reshape(*place.shape, PIXELS)
    composite_in_place(weights)
    return weights


def _pairs(
    ellipses: Ellipses, band: Band
) -> tuple[Int[np.ndarray, " pair"], Float[np.ndarray, "6 more_pairs"], Float[np.ndarray, "7 more_pairs"]]:
    """Tiles (ascending) and the Gaussians they meet from front to back: log alpha's terms and channels of each pair.

    The last column is an extra one, of a Gaussian that is nowhere.
    """
    met = pairs_met(ellipses.table[:8], band)
    depth, depth_u, depth_v = ellipses.table[9:12].take(met.splat, axis=1)
    peak = depth + depth_u * met.u + depth_v * met.v
    order = _front_to_back(met.tile, peak)
    count = len(order)
    splat, u, v = met.splat.take(order), met.u.take(order), met.v.take(order)
    uu, uv, vv, log_opacity = ellipses.table[_FORM].take(splat, axis=1)
    slope_u, slope_v = uu * u + uv * v, uv * u + vv * v
    terms, channels = np.empty((6, count + 1), np.float32), np.empty((_CHANNELS, count + 1), np.float32)
    terms[0, :count] = log_opacity - (slope_u * u + slope_v * v) / 2
    for row, values in enumerate((slope_u, slope_v, uu / 2, uv, vv / 2), start=1):
        np.negative(values, out=terms[row, :count])
    channels[0, :count] = peak.take(order)
    channels[1:6, :count] = ellipses.table[10:].take(splat, axis=1)
    channels[6, :count] = 1
    terms[:, count], channels[:, count] = (_NOTHING, 0, 0, 0, 0, 0), 0
    return met.tile.take(order), terms, channels


def _front_to_back(tile: Int[np.ndarray, " pair"], peak: Float[np.ndarray, " pair"]) -> Int[np.ndarray, " pair"]:
    """Order of the pairs by tile and then by depth: one sort of packed keys."""
    if not len(tile):
        return tile
    near, far = float(peak.min()), float(peak.max())
    step = ((peak - near) * ((2**_DEPTH_BITS - 1) / max(far - near, 1e-6))).astype(np.int64)
    bits = len(tile).bit_length()
    keys = (((tile << _DEPTH_BITS) | step) << bits) | np.arange(len(tile))
    keys.sort()
    return keys & ((1 << bits) - 1)
