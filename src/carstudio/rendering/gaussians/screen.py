"""A picture of Gaussians by its 4 x 4 tiles of pixels: sorted once per tile instead of once per ray.

Every Gaussian is entered in the tiles that it reaches, each tile sorts its own by where they peak along its middle ray,
and all 16 pixels composite them in that order. Where two Gaussians cross within a tile, some of its pixels have them in
the wrong order; nothing is left out. A pixel (column i, row j) is its centre (i + 0.5, j + 0.5).
"""

import numpy as np
from jaxtyping import Float, Int

from carstudio.rendering.gaussians.ellipses import Ellipses

_SIDE = 4  # px of a tile
_PIXELS = _SIDE**2
_EDGE = (_SIDE - 1) / 2  # px from a tile's middle to its outermost pixel centres, along each axis
_U = np.tile(np.arange(_SIDE, dtype=np.float32) - _EDGE, _SIDE)  # of a tile's pixels, from its middle
_V = np.repeat(np.arange(_SIDE, dtype=np.float32) - _EDGE, _SIDE)
_MONOMIALS = np.stack([np.ones_like(_U), _U, _V, _U * _U, _U * _V, _V * _V])
_BAND = 4096  # tiles of a band of the picture: bounds the memory
_CHUNK = 2**17  # pixel-Gaussian pairs composited at a time: they fit the cache
_DEPTH_BITS = 20  # of a sort key
_NOTHING = -1e4  # a logarithm whose exponential is 0
_CHANNELS = 7  # r, g, b, 1, depth in the tile's middle, its change along u and v


def draw_ellipses(ellipses: Ellipses, width: int, height: int) -> Float[np.ndarray, "height width 5"]:
    """Premultiplied rgb over black, opacity and depth (m, mean over the weights; 0 where nothing is)."""
    columns, rows = -(-width // _SIDE), -(-height // _SIDE)
    tiles = np.zeros((rows, columns, _PIXELS, 5), dtype=np.float32)
    step = max(1, _BAND // columns)
    for first in range(0, rows, step):
        band = tiles[first : first + step]
        _draw_band(ellipses, first, columns, band.reshape(-1, _PIXELS, 5))
    pixels = tiles.reshape(rows, columns, _SIDE, _SIDE, 5).swapaxes(1, 2).reshape(rows * _SIDE, columns * _SIDE, 5)
    return np.ascontiguousarray(pixels[:height, :width])


def _draw_band(ellipses: Ellipses, first_row: int, columns: int, into: Float[np.ndarray, "tile pixel 5"]) -> None:
    """Composite every tile of some rows of tiles, fullest tiles first, as many at a time as fit the cache."""
    tile, terms, channels = _pairs(ellipses, first_row, columns, len(into) // columns)
    if not len(tile):
        return
    start = np.flatnonzero(np.diff(tile, prepend=-1))
    count = np.diff(start, append=len(tile))
    order = np.argsort(-count)
    done = 0
    while done < len(order):
        most = int(count[order[done]])
        some = order[done : done + max(1, _CHUNK // (_PIXELS * most))]
        rank = np.arange(most)[:, None]
        place = np.where(rank < count[some], start[some] + rank, len(tile))  # the last entry of `terms` is nothing
        weights = _weights(terms, place)
        sums = np.matmul(weights.transpose(1, 2, 0), channels.take(place.T, axis=0))
        depth = sums[..., 4] + sums[..., 5] * _U + sums[..., 6] * _V
        into[tile[start[some]]] = np.concatenate(
            [sums[..., :4], (depth / np.maximum(sums[..., 3], 1e-8))[..., None]], axis=-1
        )
        done += len(some)


def _weights(
    terms: Float[np.ndarray, "pair 6"], place: Int[np.ndarray, "rank tile"]
) -> Float[np.ndarray, "rank tile pixel"]:
    """alpha_i prod_{j<i} (1 - alpha_j) of each tile's Gaussians, front first, in each of its pixels."""
    weights = terms.take(place.ravel(), axis=0) @ _MONOMIALS
    np.exp(weights, out=weights)
    weights = weights.reshape(*place.shape, _PIXELS)
    passing = np.ones(weights.shape[1:], dtype=np.float32)
    for weight in weights:
        weight *= passing
        passing -= weight
    return weights


def _pairs(
    ellipses: Ellipses, first_row: int, columns: int, rows: int
) -> tuple[Int[np.ndarray, " pair"], Float[np.ndarray, "more_pairs 6"], Float[np.ndarray, "more_pairs 7"]]:
    """Tiles (ascending) and the Gaussians they meet from front to back: log alpha's terms and channels of each pair.

    The last row of terms and channels is an extra one, of a Gaussian that is nowhere.
    """
    splat, tile_u, tile_v = _reached(ellipses, first_row, columns, rows)
    u, v, uu, uv, vv, limit = ellipses.table[:6].take(splat, axis=1)
    u, v = tile_u * _SIDE + _SIDE / 2 - u, (first_row + tile_v) * _SIDE + _SIDE / 2 - v
    slope_u, slope_v = uu * u + uv * v, uv * u + vv * v
    distance2 = slope_u * u + slope_v * v
    # a convex form lies above its tangent: no pixel of the tile is nearer than this
    met = np.flatnonzero(distance2 - 2 * _EDGE * (np.abs(slope_u) + np.abs(slope_v)) < limit)
    splat, tile = splat[met], tile_v[met] * columns + tile_u[met]
    log_opacity, depth, depth_u, depth_v = ellipses.table[8:].take(splat, axis=1)
    peak = depth + depth_u * u[met] + depth_v * v[met]
    order = _front_to_back(tile, peak)
    met = met[order]
    count = len(order)
    terms, channels = np.empty((count + 1, 6), np.float32), np.empty((count + 1, _CHANNELS), np.float32)
    terms[:count, 0] = log_opacity[order] - distance2[met] / 2
    for column, values in enumerate((slope_u, slope_v, uu / 2, uv, vv / 2), start=1):
        terms[:count, column] = -values[met]
    channels[:count, :3] = ellipses.rgb.take(splat[order], axis=0)
    for column, values in enumerate((peak, depth_u, depth_v), start=4):
        channels[:count, column] = values[order]
    channels[:count, 3] = 1
    terms[count], channels[count] = (_NOTHING, 0, 0, 0, 0, 0), 0
    return tile[order], terms, channels


def _reached(
    ellipses: Ellipses, first_row: int, columns: int, rows: int
) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]:
    """Gaussian, column and row (of the band) of every tile with a pixel centre in a Gaussian's bounding rectangle."""
    u, v = ellipses.table[:2]
    half_width, half_height = ellipses.table[6:8]
    left, right = _span(u - half_width, u + half_width, 0, columns)
    top, bottom = _span(v - half_height, v + half_height, first_row, rows)
    wide = right - left
    count = wide * (bottom - top)
    splat = np.repeat(np.arange(len(u)), count)
    within = np.arange(len(splat)) - (np.cumsum(count) - count)[splat]
    down, across = np.divmod(within, wide[splat])
    return splat, left[splat] + across, top[splat] + down


def _span(low: np.ndarray, high: np.ndarray, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """From which tile to before which, counted from `first`: those with a pixel centre between low and high (px)."""
    begin = np.ceil((low - (_SIDE - 0.5)) / _SIDE) - first
    end = np.floor((high - 0.5) / _SIDE) + 1 - first
    begin = begin.clip(0, count)
    return begin.astype(np.int64), np.maximum(end.clip(0, count), begin).astype(np.int64)


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
