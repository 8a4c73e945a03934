"""Several pictures on one: contact sheets with captions, and rows side by side under common heads."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from carstudio.images import to_uint8
from carstudio.report.colours import Colour, colour_depth, turbo

PAPER: Colour = (248, 249, 250)
INK: Colour = (33, 37, 41)
TILE_GROUND: Colour = (222, 226, 230)  # what a tile shows around a picture of another shape
GAP_PX = 8
TILE_WIDTH_PX = 160
TEXT_PX = 13
VIEW_HEADS = ("input", "truth", "ours", "opacity", "depth")

Pixels = UInt8[np.ndarray, "_h _w 3"]


@dataclass(frozen=True)
class Tile:
    """A picture and what stands below it."""

    picture: Pixels
    caption: str = ""


def fit(picture: Pixels, width: int, height: int) -> Pixels:
    """The whole picture scaled (shape kept) and centred on width x height."""
    scale = min(width / picture.shape[1], height / picture.shape[0])
    size = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
    scaled = Image.fromarray(picture).resize(size, Image.Resampling.BICUBIC)
    ground = Image.new("RGB", (width, height), TILE_GROUND)
    ground.paste(scaled, ((width - size[0]) // 2, (height - size[1]) // 2))
    return np.array(ground)


def usual_size(pictures: Sequence[Pixels]) -> tuple[int, int]:
    """(width, height) of a tile that suits most of the pictures: `TILE_WIDTH_PX` wide, of their median shape."""
    shape = float(np.median([picture.shape[0] / picture.shape[1] for picture in pictures]))
    return TILE_WIDTH_PX, round(TILE_WIDTH_PX * min(max(shape, 0.4), 1.3))


def contact_sheet(
    tiles: Sequence[Tile], *, columns: int | None = None, tile_px: tuple[int, int] | None = None
) -> Pixels:
    """Tiles of one size (width, height) in reading order; as many columns as make the sheet about 3 : 2."""
    assert tiles, "a contact sheet needs a picture"
    tile_px = tile_px or usual_size([tile.picture for tile in tiles])
    columns = columns or max(1, min(len(tiles), round(math.sqrt(len(tiles) * 1.5 * tile_px[1] / tile_px[0]))))
    lines = max(tile.caption.count("\n") + 1 if tile.caption else 0 for tile in tiles)
    rows = [tiles[start : start + columns] for start in range(0, len(tiles), columns)]
    return _grid(rows, columns, tile_px, below_px=round(lines * TEXT_PX * 1.35) + (4 if lines else 0))


def side_by_side(
    rows: Sequence[Sequence[Pixels]],
    *,
    heads: Sequence[str] = VIEW_HEADS,
    captions: Sequence[str] = (),
    tile_px: tuple[int, int] | None = None,
) -> Pixels:
    """Rows of pictures in columns under `heads`; `captions` (one per row) stand below each row's first picture."""
    assert rows, "there must be a row"
    assert all(len(row) == len(heads) for row in rows), "every row needs one picture per head"
    assert not captions or len(captions) == len(rows), "one caption per row, or none"
    tile_px = tile_px or usual_size([picture for row in rows for picture in row])
    tiles = [
        [Tile(picture, captions[i] if captions and j == 0 else "") for j, picture in enumerate(row)]
        for i, row in enumerate(rows)
    ]
    body = _grid(tiles, len(heads), tile_px, below_px=round(TEXT_PX * 1.35) + 4 if captions else 0)
    sheet = Image.new("RGB", (body.shape[1], body.shape[0] + TEXT_PX + GAP_PX), PAPER)
    sheet.paste(Image.fromarray(body), (0, TEXT_PX + GAP_PX))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(TEXT_PX)
    for column, head in enumerate(heads):
        centre = GAP_PX + column * (tile_px[0] + GAP_PX) + tile_px[0] / 2
        draw.text((centre, GAP_PX - 2), head, INK, font, anchor="ma")
    return np.array(sheet)


def named_rows(rows: Sequence[tuple[str, Pixels]]) -> Pixels:
    """Pictures of one width below each other, each with its name to the left; a gap where the name is empty."""
    font = ImageFont.load_default(TEXT_PX)
    left = 2 * GAP_PX + math.ceil(max(font.getlength(name) for name, _ in rows))
    heights = [picture.shape[0] if name else GAP_PX for name, picture in rows]
    sheet = Image.new("RGB", (left + rows[0][1].shape[1], sum(heights)), PAPER)
    draw, top = ImageDraw.Draw(sheet), 0
    for (name, picture), height in zip(rows, heights, strict=True):
        if name:
            sheet.paste(Image.fromarray(picture), (left, top))
            draw.text((GAP_PX, top + height / 2), name, INK, font, anchor="lm")
        top += height
    return np.array(sheet)


def view_pictures(
    *,
    source: Pixels,
    truth: Pixels,
    rgb: Float[np.ndarray, "height width 3"],
    opacity: Float[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
) -> list[Pixels]:
    """The pictures of one scored view in the order of `VIEW_HEADS`: input photo, truth, rendering, opacity, depth.

    Depth is shown where opacity exceeds one half.
    """
    depth = np.where(opacity > 0.5, depth_m, np.nan)
    return [source, truth, to_uint8(rgb), turbo(opacity), colour_depth(depth)]


def _grid(rows: Sequence[Sequence[Tile]], columns: int, tile_px: tuple[int, int], *, below_px: int) -> Pixels:
    width, height = tile_px
    step_x, step_y = width + GAP_PX, height + below_px + GAP_PX
    sheet = Image.new("RGB", (GAP_PX + columns * step_x, GAP_PX + len(rows) * step_y), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(TEXT_PX)
    for i, row in enumerate(rows):
        for j, tile in enumerate(row):
            x, y = GAP_PX + j * step_x, GAP_PX + i * step_y
            sheet.paste(Image.fromarray(fit(tile.picture, width, height)), (x, y))
            for line, text in enumerate(tile.caption.split("\n")):
                place = x, y + height + 4 + round(line * TEXT_PX * 1.35)
                draw.text(place, shorten(text, width, font), INK, font)
    return np.array(sheet)


def shorten(text: str, width_px: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """`text`, or as much of its start as fits with three dots."""
    if font.getlength(text) <= width_px:
        return text
    while text and font.getlength(text + "...") > width_px:
        text = text[:-1]
    return text + "..."
