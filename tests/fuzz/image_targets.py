"""Target: photographs, masks and depth in every format that is read."""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from carstudio.errors import InputError
from carstudio.images import MAX_IMAGE_PIXELS, decode_depth, decode_image, encode_depth, image_size
from fuzz.edits import Files
from fuzz.target import Target

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"


def _encoded(image: Image.Image, kind: str, **options: object) -> Files:
    buffer = io.BytesIO()
    image.save(buffer, kind, **options)
    return {"photo": buffer.getvalue()}


def image_seeds() -> list[Files]:
    """Small pictures of all kinds, with EXIF, palettes, transparency, frames."""
    rgb = np.random.default_rng(0).integers(0, 256, (12, 16, 3), dtype=np.uint8)
    photo, grey = Image.fromarray(rgb), Image.fromarray(rgb[..., 0])
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x829A] = 6, "Maker", 0.01
    palette = photo.convert("P")
    return [
        _encoded(photo, "PNG", exif=exif),
        _encoded(palette, "PNG", transparency=3),
        _encoded(photo.convert("RGBA"), "PNG"),
        {"photo": encode_depth(np.random.default_rng(1).uniform(0, 80, (12, 16)))},
        _encoded(photo, "JPEG", exif=exif),
        _encoded(photo, "JPEG", progressive=True),
        _encoded(photo.convert("CMYK"), "JPEG"),
        _encoded(palette, "GIF", save_all=True, append_images=[palette.rotate(90)], duration=50, transparency=2),
        _encoded(photo, "BMP"),
        _encoded(photo, "TIFF", compression="tiff_lzw"),
        _encoded(photo.convert("CMYK"), "TIFF", exif=exif),
        _encoded(grey.convert("I;16"), "TIFF"),
        _encoded(photo, "WEBP", lossless=True),
        _encoded(photo, "WEBP", save_all=True, append_images=[photo.rotate(180)]),
    ]


def mend_png(files: Files) -> Files:
    """Right CRCs for a PNG's chunks; other formats have none."""
    data = files["photo"]
    if not data.startswith(PNG_MAGIC):
        return files
    out, at = bytearray(PNG_MAGIC), len(PNG_MAGIC)
    while at + 8 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        body = data[at + 4 : at + 8 + min(length, len(data))]
        out += data[at : at + 4] + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + min(length, len(data))
    return {"photo": bytes(out)}


def read_photo(files: Files, folder: Path) -> None:
    """As a photograph, as a mask, as depth; the size that is told without decoding is the decoded one."""
    data = files["photo"]
    readers = (lambda: decode_image(data, name="a"), lambda: decode_image(data, name="a", mode="L"))
    refusals: list[InputError] = []
    for reader, channels in zip(readers, ((3,), ()), strict=True):
        try:
            pixels = reader()
        except InputError as error:
            refusals.append(error)
            continue
        assert pixels.dtype == np.uint8
        assert pixels.shape[2:] == channels
        assert 0 < pixels.shape[0] * pixels.shape[1] <= MAX_IMAGE_PIXELS
        assert image_size(data, name="a") == pixels.shape[1::-1]
    try:
        depth = decode_depth(data, name="a")
        assert depth.dtype == np.float32
        assert (np.isnan(depth) | (depth > 0)).all()
        assert not np.isinf(depth).any()
    except InputError as error:
        refusals.append(error)
    if len(refusals) == 3:
        raise refusals[0]


IMAGE_TARGETS = (Target("image", image_seeds, read_photo, mend_png),)
