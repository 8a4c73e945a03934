"""Pixels in and out: every kind of file a person may have, broken ones, and bombs; depth in KITTI's steps."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from carstudio.errors import InputError
from carstudio.images import (
    decode_depth,
    decode_image,
    encode_depth,
    encode_jpeg,
    encode_png,
    image_size,
    read_image,
    to_uint8,
    write_png,
)

RGB = np.random.default_rng(0).integers(0, 256, size=(5, 7, 3), dtype=np.uint8)
SMOOTH = np.stack(np.broadcast_arrays(np.arange(48)[None] * 5, np.arange(32)[:, None] * 7, 90), axis=-1).astype(
    np.uint8
)


def encoded(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def test_png_keeps_every_pixel_and_opencv_agrees():
    data = encode_png(RGB)
    np.testing.assert_array_equal(decode_image(data, name="a.png"), RGB)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1], RGB)


def test_masks_keep_their_three_values():
    mask = np.array([[0, 128, 255]], dtype=np.uint8)
    np.testing.assert_array_equal(decode_image(encode_png(mask), name="m.png", mode="L"), mask)


def test_jpeg_is_close_and_quality_costs_bytes():
    good, poor = encode_jpeg(SMOOTH, quality=95), encode_jpeg(SMOOTH, quality=30)
    assert len(poor) < len(good)
    assert np.abs(decode_image(good, name="a.jpg").astype(int) - SMOOTH).mean() < 3


# EXIF orientation -> what turns the stored pixels upright, written with numpy. From the EXIF standard's table.
UPRIGHT = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: np.rot90(a, 1),
}


@pytest.mark.parametrize("orientation", sorted(UPRIGHT))
def test_photos_stand_upright(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(Image.fromarray(RGB), exif=exif)
    pixels = decode_image(data, name="phone.png")
    np.testing.assert_array_equal(pixels, UPRIGHT[orientation](RGB))
    assert image_size(data, name="phone.png") == (pixels.shape[1], pixels.shape[0])


@pytest.mark.parametrize("orientation", [0, 9, 6000])
def test_orientations_that_do_not_exist_are_ignored(orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(Image.fromarray(RGB), exif=exif)
    np.testing.assert_array_equal(decode_image(data, name="a.png"), RGB)


def test_sixteen_bit_grey_keeps_its_upper_byte():
    grey = np.array([[0, 255, 256, 32768, 65535]], dtype=np.uint16)
    pixels = decode_image(encode_png(grey), name="a.png")
    np.testing.assert_array_equal(pixels, np.repeat((grey >> 8).astype(np.uint8)[..., None], 3, axis=-1))


@pytest.mark.parametrize("mode", ["P", "L", "LA", "RGBA", "1", "CMYK", "YCbCr"])
def test_every_colour_mode_becomes_rgb(mode):
    kind = "TIFF" if mode in ("CMYK", "YCbCr") else "PNG"
    stored = Image.fromarray(SMOOTH).convert(mode)
    pixels = decode_image(encoded(stored, kind), name="a")
    assert pixels.shape == SMOOTH.shape
    np.testing.assert_array_equal(pixels, np.array(stored.convert("RGB")))


def test_cmyk_jpeg_has_the_photos_colours():
    data = encoded(Image.fromarray(SMOOTH).convert("CMYK"), "JPEG", quality=95)
    assert np.abs(decode_image(data, name="press.jpg").astype(int) - SMOOTH).mean() < 5


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "GIF", "BMP", "TIFF", "WEBP"])
def test_truncated_files_are_named_not_half_decoded(kind):
    data = encoded(Image.fromarray(np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)), kind)
    for share in (0.0, 0.02, 0.3, 0.7):
        with pytest.raises(InputError, match=r"^holiday\.img: .*(empty|broken|expected)"):
            decode_image(data[: int(len(data) * share)], name="holiday.img")


@pytest.mark.parametrize("data", [b"", b"\0" * 100, b"<html>404</html>", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_named(data):
    if not data:
        with pytest.raises(InputError, match=r"^x\.png: expected an image, found an empty file"):
            decode_image(data, name="x.png")
    for read in (decode_image, image_size, decode_depth):
        with pytest.raises(InputError, match=r"^x\.png: expected an image"):
            read(data, name="x.png")


def png_that_claims(width: int, height: int) -> bytes:
    """A PNG of a few bytes that says it is huge."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 1000))
        + chunk(b"IEND", b"")
    )


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("size", [(100_000, 100_000), (12_001, 10_000), (2**31 - 1, 2**31 - 1)])
def test_bombs_are_refused_by_their_header(size):
    for read in (decode_image, image_size, decode_depth):
        with pytest.raises(InputError, match=r"^bomb\.png: .*at most 120,000,000|^bomb\.png: expected an image"):
            read(png_that_claims(*size), name="bomb.png")


@pytest.mark.filterwarnings("ignore::UserWarning")
@settings(max_examples=150)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=6), st.booleans())
def test_damaged_photos_give_pixels_or_one_kind_of_error(damage, in_header):
    """Any damage, broken EXIF included, ends in pixels or `InputError`: one bad file must not kill a run."""
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x829A] = 6, "Maker", 0.01
    data = bytearray(encoded(Image.fromarray(SMOOTH), "JPEG", exif=exif))
    reach = 150 if in_header else len(data)
    for place, value in damage:
        data[place % reach] = value
    try:
        found = decode_image(bytes(data), name="a.jpg").ndim
    except InputError as error:
        found = str(error)
    assert found == 3 or found.startswith("a.jpg: ")


def test_files_are_written_and_read(tmp_path):
    write_png(tmp_path / "new" / "a.png", RGB)
    np.testing.assert_array_equal(read_image(tmp_path / "new" / "a.png"), RGB)
    with pytest.raises(InputError, match=r"absent\.png: image cannot be read \(No such file"):
        read_image(tmp_path / "absent.png")


def test_depth_is_kittis_sixteen_bit_png():
    depth = np.array([[1.0, 0.5, 80.25, 255.99]], dtype=np.float32)
    data = encode_depth(depth)
    stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert stored.tolist() == [[256, 128, 20544, 65533]]
    np.testing.assert_allclose(decode_depth(data, name="d.png"), depth, atol=0.5 / 256)


def test_no_depth_is_zero_in_the_file_and_nan_in_memory():
    depth = np.array([[np.nan, np.inf, -1.0, 0.0, 3.0]], dtype=np.float32)
    back = decode_depth(encode_depth(depth), name="d.png")
    assert np.isnan(back[0, :4]).all()
    assert back[0, 4] == 3.0


@given(st.floats(0.002, 255.9))
def test_depth_comes_back_to_half_a_step(metres):
    back = decode_depth(encode_depth(np.array([[metres]])), name="d.png")[0, 0]
    assert abs(back - metres) <= 0.5 / 256 + 1e-6


def test_depth_beyond_the_range_is_the_farthest():
    assert decode_depth(encode_depth(np.array([[1000.0]])), name="d.png")[0, 0] == pytest.approx(65535 / 256)


def test_broken_depth_is_named():
    noisy = np.random.default_rng(0).uniform(1, 80, size=(64, 64))
    data = encode_depth(noisy)
    with pytest.raises(InputError, match=r"^d\.png: .*broken"):
        decode_depth(data[: len(data) // 2], name="d.png")
    with pytest.raises(InputError, match=r"^d\.png: expected a 16-bit grey depth image"):
        decode_depth(encode_png(RGB), name="d.png")


def test_floats_become_bytes_rounded_and_clipped():
    values = np.array([-1.0, 0.0, 0.499 / 255, 0.501 / 255, 0.5, 1.0, 7.0])
    assert to_uint8(values).tolist() == [0, 0, 0, 1, 128, 255, 255]
