"""Contact sheets: every picture stands where the grid says, whole and undistorted; captions are cut, not spilt."""

import numpy as np
import pytest
from PIL import ImageFont

from carstudio.report.colours import NO_DEPTH, turbo
from carstudio.report.sheets import (
    GAP_PX,
    PAPER,
    TEXT_PX,
    TILE_GROUND,
    VIEW_HEADS,
    Tile,
    contact_sheet,
    fit,
    shorten,
    side_by_side,
    usual_size,
    view_pictures,
)


def plain(height: int, width: int, colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


COLOURS = [(250, 0, 0), (0, 250, 0), (0, 0, 250), (250, 250, 0), (0, 250, 250)]


def test_pictures_stand_in_reading_order() -> None:
    sheet = contact_sheet([Tile(plain(30, 40, colour)) for colour in COLOURS], columns=3, tile_px=(40, 30))
    assert sheet.shape == (GAP_PX + 2 * (30 + GAP_PX), GAP_PX + 3 * (40 + GAP_PX), 3)
    expected = plain(*sheet.shape[:2], PAPER)
    for number, colour in enumerate(COLOURS):
        row, column = divmod(number, 3)
        y, x = GAP_PX + row * (30 + GAP_PX), GAP_PX + column * (40 + GAP_PX)
        expected[y : y + 30, x : x + 40] = colour
    assert np.array_equal(sheet, expected)


def test_captions_stand_below_their_picture_within_its_width() -> None:
    long = "a caption that is much too long for a tile of this width, and then some"
    tiles = [Tile(plain(30, 100, COLOURS[0]), long), Tile(plain(30, 100, COLOURS[1]))]
    sheet = contact_sheet(tiles, columns=2, tile_px=(100, 30))
    below = sheet[GAP_PX + 30 : -GAP_PX]
    is_ink = (below != PAPER).any(axis=-1)
    assert is_ink[:, GAP_PX : GAP_PX + 100].sum() > 50
    assert not is_ink[:, GAP_PX + 101 :].any()
    assert not is_ink[:, :GAP_PX].any()


def test_a_second_line_makes_room() -> None:
    one, two = (contact_sheet([Tile(plain(30, 60, COLOURS[0]), text)], tile_px=(60, 30)) for text in ("a", "a\nb"))
    assert two.shape[0] - one.shape[0] == round(2 * TEXT_PX * 1.35) - round(TEXT_PX * 1.35)


@pytest.mark.parametrize(("height", "width"), [(20, 80), (80, 20), (30, 40), (301, 399)])
def test_fit_shows_all_of_a_picture_in_its_shape(height: int, width: int) -> None:
    """A picture of one colour: what is not ground has the picture's shape and lies in the middle."""
    fitted = fit(plain(height, width, (10, 20, 30)), 100, 60)
    assert fitted.shape == (60, 100, 3)
    rows, columns = np.nonzero((fitted != TILE_GROUND).any(axis=-1))
    tall, wide = np.ptp(rows) + 1, np.ptp(columns) + 1
    assert tall == 60 or wide == 100
    assert abs(wide / tall - width / height) < 1.5 * (width / height) / min(tall, wide)
    assert abs(rows.min() - (59 - rows.max())) <= 1
    assert abs(columns.min() - (99 - columns.max())) <= 1


def test_usual_size_is_the_median_shape_and_bounded() -> None:
    assert usual_size([plain(20, 40, COLOURS[0])] * 2 + [plain(90, 30, COLOURS[0])]) == (160, 80)
    assert usual_size([plain(400, 10, COLOURS[0])]) == (160, 208)
    assert usual_size([plain(1, 100, COLOURS[0])]) == (160, 64)


def test_rows_stand_under_their_heads() -> None:
    rows = [[plain(20, 50, colour) for colour in COLOURS] for _ in range(2)]
    sheet = side_by_side(rows, captions=["first", "second"], tile_px=(50, 20))
    body = sheet[TEXT_PX + GAP_PX :]
    for column, colour in enumerate(COLOURS):
        x = GAP_PX + column * (50 + GAP_PX)
        assert (body[GAP_PX : GAP_PX + 20, x : x + 50] == colour).all()
        head = (sheet[: TEXT_PX + GAP_PX, x : x + 50] != PAPER).any(axis=-1)
        assert head.sum() > 10
        middle = np.nonzero(head)[1].mean()
        assert abs(middle - 24.5) < 6  # centred above its column
    with pytest.raises(AssertionError, match="one picture per head"):
        side_by_side([rows[0][:4]])


def test_a_scored_view_is_shown_in_the_order_of_its_heads() -> None:
    rng = np.random.default_rng(0)
    source, truth = (rng.integers(0, 255, (8, 9, 3), dtype=np.uint8) for _ in range(2))
    opacity = np.full((8, 9), 0.9, np.float32)
    opacity[:, :4] = 0.4
    pictures = view_pictures(
        source=source,
        truth=truth,
        rgb=np.full((8, 9, 3), 0.5, np.float32),
        opacity=opacity,
        depth_m=np.full((8, 9), 10.0, np.float32),
    )
    shown = dict(zip(VIEW_HEADS, pictures, strict=True))
    assert np.array_equal(shown["input"], source)
    assert np.array_equal(shown["truth"], truth)
    assert set(np.unique(shown["ours"])) <= {127, 128}
    assert np.array_equal(shown["opacity"], turbo(opacity))
    assert (shown["depth"][:, :4] == NO_DEPTH).all()  # half transparent and less: no depth
    assert (shown["depth"][:, 4:] != NO_DEPTH).any()


def test_shortened_text_fits_and_keeps_its_start() -> None:
    font = ImageFont.load_default(TEXT_PX)
    assert shorten("short", 200, font) == "short"
    cut = shorten("a text of some length", 60, font)
    assert cut.endswith("...")
    assert "a text of some length".startswith(cut[:-3])
    assert font.getlength(cut) <= 60
