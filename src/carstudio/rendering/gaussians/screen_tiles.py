"""Which 4 x 4 tiles of a picture each ellipse reaches, and tiles worked on together: what two ways of drawing share.

A pixel (column i, row j) is its centre (i + 0.5, j + 0.5).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SIDE = 4  # px of a tile
PIXELS = SIDE**2
_EDGE = (SIDE - 1) / 2  # px from a tile's middle to its outermost pixel centres, along each axis
U = np.tile(np.arange(SIDE, dtype=np.float32) - _EDGE, SIDE)  # of a tile's pixels, from its middle
V = np.repeat(np.arange(SIDE, dtype=np.float32) - _EDGE, SIDE)
MONOMIALS = np.stack([np.ones_like(U), U, V, U * U, U * V, V * V])
_BAND = 4096  # tiles of a band of the picture: bounds the memory
_CHUNK = 2**17  # pixel-Gaussian pairs composited at a time: they fit the cache


@dataclass(frozen=True)
class Pairs:
    """Gaussians and the tiles that their ellipses reach: `u`, `v` lead from an ellipse's middle to its tile's (px)."""

    splat: Int[np.ndarray, " pair"]
    tile: Int[np.ndarray, " pair"]
    u: Float[np.ndarray, " pair"]
    v: Float[np.ndarray, " pair"]
    slope_u: Float[np.ndarray, " pair"]
    """Half the slope of the squared distance in the tile's middle, along u and v."""
    slope_v: Float[np.ndarray, " pair"]
    distance2: Float[np.ndarray, " pair"]


def draw_by_bands(
    width: int, height: int, draw_band: Callable[[int, int, Float[np.ndarray, "tile pixel 5"]], None]
) -> Float[np.ndarray, "height width 5"]:
    """A picture whose tiles `draw_band(first row of tiles, columns, into)` fills in, some rows of tiles at a time."""
    columns, rows = -(-width // SIDE), -(-height // SIDE)
    tiles = np.zeros((rows, columns, PIXELS, 5), dtype=np.float32)
    step = max(1, _BAND // max(1, columns))
    for first in range(0, rows, step):
        draw_band(first, columns, tiles[first : first + step].reshape(-1, PIXELS, 5))
    pixels = tiles.reshape(rows, columns, SIDE, SIDE, 5).swapaxes(1, 2).reshape(rows * SIDE, columns * SIDE, 5)
    return np.ascontiguousarray(pixels[:height, :width])


def pairs_met(table: Float[np.ndarray, "8 splat"], first_row: int, columns: int, rows: int) -> Pairs:
    """Every tile of a band with each ellipse that may reach a pixel centre of it, ellipse by ellipse.

    Rows of `table`: u and v of the middle (px); the form's uu, uv and vv (px^-2); the squared distance of the edge;
    half width and half height (px) of the ellipse up to there.
    """
    splat, tile_u, tile_v = _within_rectangles(table, first_row, columns, rows)
    u, v, uu, uv, vv, limit = table[:6].take(splat, axis=1)
    u, v = tile_u * SIDE + SIDE / 2 - u, (first_row + tile_v) * SIDE + SIDE / 2 - v
    slope_u, slope_v = uu * u + uv * v, uv * u + vv * v
    distance2 = slope_u * u + slope_v * v
    # a convex form lies above its tangent: no pixel of the tile is nearer than this
    met = np.flatnonzero(distance2 - 2 * _EDGE * (np.abs(slope_u) + np.abs(slope_v)) < limit)
    tile = tile_v[met] * columns + tile_u[met]
    return Pairs(splat[met], tile, u[met], v[met], slope_u[met], slope_v[met], distance2[met])


def fullest_first(
    tile: Int[np.ndarray, " pair"],
) -> Iterator[tuple[Int[np.ndarray, " tile"], Int[np.ndarray, "tile rank"]]]:
    """Tiles of pairs sorted by tile, as many at a time as fit the cache, and the pairs of each.

    Where a tile has fewer than the fullest of its group, the number of pairs stands for none.
    """
    if not len(tile):
        return
    start = np.flatnonzero(np.diff(tile, prepend=-1))
    count = np.diff(start, append=len(tile))
    order = np.argsort(-count)
    done = 0
    while done < len(order):
        most = int(count[order[done]])
        some = order[done : done + max(1, _CHUNK // (PIXELS * most))]
        rank = np.arange(most)
        yield tile[start[some]], np.where(rank < count[some, None], start[some, None] + rank, len(tile))
        done += len(some)


def composite_in_place(alpha: np.ndarray) -> None:
    """Alphas (rank, ...), front first, to weights alpha_i prod_{j<i} (1 - alpha_j)."""
    passing = np.ones_like(alpha[0])
    for weight in alpha:
        weight *= passing
        passing -= weight


def _within_rectangles(
    table: Float[np.ndarray, "8 splat"], first_row: int, columns: int, rows: int
) -> tuple[Int[np.ndarray, " pair"], Int[np.ndarray, " pair"], Int[np.ndarray, " pair"]]:
    """Ellipse, column and row (of the band) of every tile with a pixel centre in the ellipse's bounding rectangle."""
    u, v = table[:2]
    half_width, half_height = table[6:8]
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
    begin = np.ceil((low - (SIDE - 0.5)) / SIDE) - first
    end = np.floor((high - 0.5) / SIDE) + 1 - first
    begin = begin.clip(0, count)
    return begin.astype(np.int64), np.maximum(end.clip(0, count), begin).astype(np.int64)
