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
    U,
    V,
    composite_in_place,
    draw_by_bands,
    fullest_first,
    pairs_met,
)

_DEPTH_BITS = 20  # of a sort key
_NOTHING = -1e4  # a logarithm whose exponential is 0
_CHANNELS = 7  # r, g, b, 1, depth in the tile's middle, its change along u and v


def draw_ellipses(ellipses: Ellipses, width: int, height: int) -> Float[np.ndarray, "height width 5"]:
    """Premultiplied rgb over black, opacity and depth (m, mean over the weights; 0 where nothing is)."""
    return draw_by_bands(width, height, partial(_draw_band, ellipses))


def _draw_band(ellipses: Ellipses, first_row: int, columns: int, into: Float[np.ndarray, "tile pixel 5"]) -> None:
    tile, terms, channels = _pairs(ellipses, first_row, columns, len(into) // columns)
    for tiles, place in fullest_first(tile):
        weights = _weights(terms, place.T)
        sums = np.matmul(weights.transpose(1, 2, 0), channels.take(place, axis=0))
        depth = sums[..., 4] + sums[..., 5] * U + sums[..., 6] * V
        into[tiles] = np.concatenate([sums[..., :4], (depth / np.maximum(sums[..., 3], 1e-8))[..., None]], axis=-1)


def _weights(
    terms: Float[np.ndarray, "pair 6"], place: Int[np.ndarray, "rank tile"]
) -> Float[np.ndarray, "rank tile pixel"]:
    """alpha_i prod_{j<i} (1 - alpha_j) of each tile's Gaussians, front first, in each of its pixels."""
    weights = terms.take(place.ravel(), axis=0) @ MONOMIALS
    np.exp(weights, out=weights)
    weights = weights.reshape(*place.shape, PIXELS)
    composite_in_place(weights)
    return weights


def _pairs(
    ellipses: Ellipses, first_row: int, columns: int, rows: int
) -> tuple[Int[np.ndarray, " pair"], Float[np.ndarray, "more_pairs 6"], Float[np.ndarray, "more_pairs 7"]]:
    """Tiles (ascending) and the Gaussians they meet from front to back: log alpha's terms and channels of each pair.

    The last row of terms and channels is an extra one, of a Gaussian that is nowhere.
    """
    met = pairs_met(ellipses.table[:8], first_row, columns, rows)
    uu, uv, vv = ellipses.table[2:5].take(met.splat, axis=1)
    log_opacity, depth, depth_u, depth_v = ellipses.table[8:].take(met.splat, axis=1)
    peak = depth + depth_u * met.u + depth_v * met.v
    order = _front_to_back(met.tile, peak)
    count = len(order)
    terms, channels = np.empty((count + 1, 6), np.float32), np.empty((count + 1, _CHANNELS), np.float32)
    terms[:count, 0] = (log_opacity - met.distance2 / 2)[order]
    for column, values in enumerate((met.slope_u, met.slope_v, uu / 2, uv, vv / 2), start=1):
        terms[:count, column] = -values[order]
    channels[:count, :3] = ellipses.rgb.take(met.splat[order], axis=0)
    for column, values in enumerate((peak, depth_u, depth_v), start=4):
        channels[:count, column] = values[order]
    channels[:count, 3] = 1
    terms[count], channels[count] = (_NOTHING, 0, 0, 0, 0, 0), 0
    return met.tile[order], terms, channels


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
