"""Which 4 x 4 tiles of a picture each ellipse reaches, and tiles worked on together: what two ways of drawing share.

A pixel (column i, row j) is its centre (i + 0.5, j + 0.5).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

SIDE = 4  # px of a tile
PIXELS = SIDE**2
_OFFSETS = np.arange(SIDE, dtype=np.float32) - (SIDE - 1) / 2
U = np.tile(_OFFSETS, SIDE)  # of a tile's pixels, from its middle
V = np.repeat(_OFFSETS, SIDE)
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


@dataclass(frozen=True)
class Band:
    """Some rows of tiles of a picture that is being drawn, from `first_row` on."""

    first_row: int
    picture: Float[np.ndarray, "rows columns side side 5"]
    """A view of the pixels, tile by tile: rgb, opacity, depth."""

    @property
    def rows(self) -> int:
        """Of tiles."""
        return self.picture.shape[0]

    @property
    def columns(self) -> int:
        """Of tiles."""
        return self.picture.shape[1]

    def put(
        self,
        tiles: Int[np.ndarray, " tile"],
        colour: Float[np.ndarray, "tile pixel 4"],
        depth: Float[np.ndarray, "tile pixel"],
    ) -> None:
        """Fill in tiles, counted row by row: rgb and opacity, and depth."""
        row, column = np.divmod(tiles, self.columns)
        self.picture[row, column, :, :, :4] = colour.reshape(-1, SIDE, SIDE, 4)
        self.picture[row, column, :, :, 4] = depth.reshape(-1, SIDE, SIDE)


def draw_by_bands(width: int, height: int, draw_band: Callable[[Band], None]) -> Float[np.ndarray, "height width 5"]:
    """A picture whose tiles `draw_band` fills in, some rows of tiles at a time."""
    columns, rows = -(-width // SIDE), -(-height // SIDE)
    pixels = np.zeros((rows * SIDE, columns * SIDE, 5), dtype=np.float32)
    tiles = pixels.reshape(rows, SIDE, columns, SIDE, 5).swapaxes(1, 2)
    step = max(1, _BAND // max(1, columns))
    for first in range(0, rows, step):
        draw_band(Band(first, tiles[first : first + step]))
    return np.ascontiguousarray(pixels[:height, :width])


def pairs_met(table: Float[np.ndarray, "8 splat"], band: Band) -> Pairs:
    """Every tile of a band with each ellipse that may reach a pixel centre of it, ellipse by ellipse.

    Rows of `table`: u and v of the middle (px); the form's uu, uv and vv (px^-2); the squared distance of the edge;
    half width and half height (px) of the ellipse up to there.
    """
    splat, tile_v, left, right = _strips(table, band)
    wide = right - left
    strip = np.repeat(np.arange(len(wide)), wide)
    tile_u = np.arange(len(strip)) - np.repeat(np.cumsum(wide) - wide - left, wide)
    splat, tile_v = splat.take(strip), tile_v.take(strip)
    u, v = table[:2].take(splat, axis=1)
    middle_u, middle_v = ((tile * SIDE + SIDE / 2).astype(np.float32) for tile in (tile_u, band.first_row + tile_v))
    return Pairs(splat, tile_v * band.columns + tile_u, middle_u - u, middle_v - v)


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


def _strips(table: Float[np.ndarray, "8 splat"], band: Band) -> tuple[Int[np.ndarray, " strip"], ...]:
    """Ellipses row of tiles by row of tiles: ellipse, row (of the band), from which column to before which.

    With k = sqrt(edge uu - (uu vv - uv^2) v^2) the ellipse spans (-uv v - k) / uu to (-uv v + k) / uu at the height v;
    the strip's ends are those of the heights nearest to where the whole ellipse has them, on either side of its middle.
    """
    v, half_height = table[1], table[7]
    top, bottom = _span(v - half_height, v + half_height, band.first_row, band.rows)
    tall = bottom - top
    splat = np.repeat(np.arange(len(tall)), tall)
    row = np.arange(len(splat)) - np.repeat(np.cumsum(tall) - tall - top, tall)
    tilt, half_chord = table[3] / table[2], np.sqrt(table[5] / table[2])
    per_ellipse = np.stack([*table[:2], half_height, tilt, half_chord / half_height, tilt * half_height**2 / table[6]])
    u, v, half_height, tilt, steepness, slant = per_ellipse.take(splat, axis=1)
    low = ((band.first_row + row) * SIDE + 0.5).astype(np.float32) - v
    high = low + np.float32(SIDE - 1)
    ends = []
    for side in (-1, 1):
        at = np.minimum(np.maximum(-side * slant, low), high)
        ends.append(u - tilt * at + side * steepness * np.sqrt(np.maximum(half_height**2 - at * at, 0)))
    left, right = _span(ends[0], ends[1], 0, band.columns)
    return splat, row, left, right


def _span(low: np.ndarray, high: np.ndarray, first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """From which tile to before which, counted from `first`: those with a pixel centre between low and high (px)."""
    begin = np.ceil((low - (SIDE - 0.5)) / SIDE) - first
    end = np.floor((high - 0.5) / SIDE) + 1 - first
    begin = begin.clip(0, count)
    return begin.astype(np.int64), np.maximum(end.clip(0, count), begin).astype(np.int64)
