"""Photographs as people have them: turned, animated, see-through, deep, damaged, huge. Each is read right or refused.

The messages are for the person whose file it is: name, what was expected, what was found, what to do.
"""

import io
import os
import struct
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from carstudio.errors import InputError
from carstudio.images import MAX_IMAGE_PIXELS, decode_image, encode_png, image_size, read_image
from test_images import RGB, UPRIGHT, encoded, png_that_claims

NOISE = np.random.default_rng(1).integers(0, 256, (64, 64, 3), dtype=np.uint8)


def refusal(data: bytes, name: str = "holiday.png") -> str:
    with pytest.raises(InputError) as caught:
        decode_image(data, name=name)
    message = str(caught.value)
    assert message.startswith(f"{name}: ")
    assert message.endswith(("replace or remove the file", "replace or remove it", "convert the file", "scale it"))
    assert "object at 0x" not in message
    return message


@pytest.mark.parametrize("kind", ["TIFF", "WEBP", "JPEG"])
@pytest.mark.parametrize("orientation", sorted(UPRIGHT))
def test_the_orientation_is_applied_once_in_every_format(kind: str, orientation: int) -> None:
    """Pillow turns TIFF by itself while it loads, the others not."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    flat = np.zeros((16, 32, 3), np.uint8)
    flat[:8, :8] = 250  # whole blocks, so that JPEG keeps them
    options = {"WEBP": {"lossless": True}, "JPEG": {"quality": 95, "subsampling": 0}}.get(kind, {})
    data = encoded(Image.fromarray(flat), kind, exif=exif, **options)
    pixels = decode_image(data, name="phone")
    expected = UPRIGHT[orientation](flat)
    assert pixels.shape == expected.shape
    assert np.abs(pixels.astype(int) - expected).max() < 12
    assert image_size(data, name="phone") == (pixels.shape[1], pixels.shape[0])


@pytest.mark.parametrize("kind", ["GIF", "PNG", "WEBP", "TIFF"])
def test_of_an_animation_the_first_picture_is_read(kind: str) -> None:
    red, green = Image.new("RGB", (8, 6), (255, 0, 0)), Image.new("RGB", (8, 6), (0, 255, 0))
    options = {"lossless": True} if kind == "WEBP" else {}
    data = encoded(red, kind, save_all=True, append_images=[green], **options)
    with Image.open(io.BytesIO(data)) as stored:
        assert stored.n_frames == 2
    np.testing.assert_array_equal(decode_image(data, name="a"), np.full((6, 8, 3), (255, 0, 0)))


@pytest.mark.parametrize("transparency", [0, bytes([0, 128, 255])])
def test_a_palette_keeps_its_colours_where_it_is_see_through(transparency: int | bytes) -> None:
    palette = Image.fromarray(RGB).quantize(8)
    data = encoded(palette, transparency=transparency)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Pillow warns of it, which tells a user nothing
        pixels = decode_image(data, name="logo.png")
    np.testing.assert_array_equal(pixels, np.array(palette.convert("RGB")))


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_sixteen_bit_colour_keeps_its_upper_byte(ending: str) -> None:
    deep = np.arange(6 * 8 * 3, dtype=np.uint16).reshape(6, 8, 3) * 400
    ok, data = cv2.imencode(ending, deep[..., ::-1])
    assert ok
    found = decode_image(data.tobytes(), name="raw").astype(int)
    assert np.abs(found - deep / 257.0).max() <= 1  # one library cuts the lower byte, another rounds


def test_floating_point_pictures_are_refused_not_made_black() -> None:
    depth = Image.fromarray(np.linspace(0, 1, 48, dtype=np.float32).reshape(6, 8))
    assert "expected 8 or 16 bits per channel, found floating-point" in refusal(encoded(depth, "TIFF"), "scan.tif")


def test_one_wrong_byte_in_the_pixels_of_a_png_is_found() -> None:
    data = bytearray(encode_png(NOISE))
    data[5000] ^= 1
    assert "broken or truncated (broken PNG file (bad header checksum in b'IDAT'))" in refusal(bytes(data))


@pytest.mark.parametrize("length", [1, 8, 30, 100, 9000])
def test_a_truncated_png_says_what_to_do(length: int) -> None:
    message = refusal(encode_png(NOISE)[:length])
    assert "broken" in message


@pytest.mark.parametrize("start", [b"%PDF-1.7\n", b"<svg xmlns='http://www.w3.org/2000/svg'/>", b"\0\0\0 ftypheic"])
def test_what_is_no_photo_is_told_by_its_first_bytes(start: bytes) -> None:
    message = refusal(start + bytes(100))
    assert "expected an image (PNG, JPEG, GIF, BMP, TIFF, WEBP, PPM)" in message
    assert repr((start + bytes(12))[:12]) in message


@pytest.mark.skipif(os.name != "posix", reason="a shell script stands for Ghostscript")
def test_postscript_that_calls_itself_a_photo_starts_no_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow would hand EPS, whatever the file is called, to the program `gs`."""
    script, witness = tmp_path / "bin" / "gs", tmp_path / "ran"
    script.parent.mkdir()
    script.write_text(f"#!/bin/sh\ntouch {witness}\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{script.parent}:{os.environ['PATH']}")
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n"
    refusal(eps, "000001.png")
    assert not witness.exists()


def test_a_text_chunk_that_unfolds_to_gigabytes_is_refused() -> None:
    png = encode_png(NOISE)
    body = b"comment\0\0" + zlib.compress(bytes(100_000_000))
    chunk = struct.pack(">I", len(body)) + b"zTXt" + body + struct.pack(">I", zlib.crc32(b"zTXt" + body))
    message = refusal(png[:33] + chunk + png[33:])
    assert "expected an image" in message or "broken" in message


def test_a_large_photo_gives_no_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow warns from 89 million pixels on; our bound is another."""
    data = encoded(Image.fromarray(RGB), "TIFF")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", RGB.shape[0] * RGB.shape[1] - 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(decode_image(data, name="scan.tif"), RGB)


def gif_that_claims(width: int, height: int) -> bytes:
    data = bytearray(encoded(Image.new("P", (10, 10)), "GIF"))
    data[6:10] = struct.pack("<HH", width, height)
    return bytes(data)


def tiff_that_claims(width: int, height: int) -> bytes:
    data = bytearray(encoded(Image.new("RGB", (10, 10)), "TIFF"))
    (start,) = struct.unpack("<I", data[4:8])
    (count,) = struct.unpack("<H", data[start : start + 2])
    sides = {256: width, 257: height}
    for place in range(start + 2, start + 2 + 12 * count, 12):
        (tag,) = struct.unpack("<H", data[place : place + 2])
        if tag in sides:
            data[place : place + 12] = struct.pack("<HHII", tag, 4, 1, sides[tag])
    return bytes(data)


PEAK = """
import resource, sys
from carstudio.errors import InputError
from carstudio.images import read_image
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    print("read", *read_image(sys.argv[1]).shape)
except InputError as error:
    print("refused", error)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def peak_mib(path: Path) -> tuple[str, float]:
    """What a fresh process says of the file, and by how much reading it raised its peak memory."""
    ended = subprocess.run([sys.executable, "-c", PEAK, str(path)], capture_output=True, text=True, check=True)
    said, kib = ended.stdout.splitlines()
    return said, int(kib) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux alone")
@pytest.mark.parametrize("make", [png_that_claims, gif_that_claims, tiff_that_claims])
@pytest.mark.parametrize("size", [(60_000, 60_000), (12_001, 10_000)])
def test_bombs_are_refused_before_they_take_memory(make: object, size: tuple[int, int], tmp_path: Path) -> None:
    """3.6 billion pixels, which Pillow refuses, and just above our own bound, which it does not."""
    (tmp_path / "bomb.png").write_bytes(make(*size))  # type: ignore[operator]  # one of three functions
    said, peak = peak_mib(tmp_path / "bomb.png")
    assert said.startswith(f"refused {tmp_path}/bomb.png: ")
    assert f"at most {MAX_IMAGE_PIXELS:,} are read; scale it" in said
    assert peak < 30  # a few MiB of imports


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux alone")
@pytest.mark.parametrize("kind", ["PNG", "GIF", "TIFF", "JPEG"])
def test_the_largest_photo_that_is_read_takes_less_than_two_gibibytes(kind: str, tmp_path: Path) -> None:
    options = {"compression": "tiff_deflate"} if kind == "TIFF" else {}
    Image.new("RGB", (12_000, 10_000)).save(tmp_path / "wall.img", kind, **options)
    assert (tmp_path / "wall.img").stat().st_size < 3e6
    said, peak = peak_mib(tmp_path / "wall.img")
    assert said == "read 10000 12000 3"
    assert peak < 2048


def test_a_folder_is_no_photo(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"image cannot be read \(Is a directory\); replace or remove it"):
        read_image(tmp_path)
