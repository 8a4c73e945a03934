"""The one place where pixels enter and leave: 8-bit RGB images, 8-bit masks, 16-bit depth.

Arrays are numpy, (height, width[, channels]). Depth images follow KITTI: value / 256 is metres, 0 is "no depth".
"""

import io
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8
from PIL import EpsImagePlugin, Image
from PIL.TiffImagePlugin import TiffImageFile

from carstudio.errors import InputError
from carstudio.files import read_bounded, write_bytes

MAX_IMAGE_PIXELS = 120_000_000  # 12,000 x 10,000: larger than any camera's photo, small enough for a laptop's memory
MAX_IMAGE_BYTES = 4 * MAX_IMAGE_PIXELS  # uncompressed, with an alpha channel
# What Pillow may open (an MPO of a phone is a JPEG). Some of its other readers start programs (EPS: Ghostscript).
FORMATS = ("PNG", "JPEG", "GIF", "BMP", "TIFF", "WEBP", "PPM")
DEPTH_STEPS_PER_METRE = 256.0  # KITTI's depth PNG
# What Pillow raises on damaged files, as fuzzing found; its bomb error also for a frame larger than its image.
BROKEN = (
    OSError, ValueError, SyntaxError, EOFError, TypeError, KeyError, IndexError, OverflowError, struct.error,
    Image.DecompressionBombError,
)  # fmt: skip
TURNS = {  # EXIF orientation -> what turns the stored pixels upright; 1 (and anything unknown) is upright
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
SIDEWAYS = {TURNS[orientation] for orientation in (5, 6, 7, 8)}


def decode_image(data: bytes, *, name: str, mode: str = "RGB") -> UInt8[np.ndarray, "height width *channels"]:
    """Pixels of an encoded image as `mode` ("RGB" or "L"), EXIF orientation applied once; of an animation the first.

    Raises `InputError` naming `name` when the bytes are not a whole image or exceed `MAX_IMAGE_PIXELS`.
    """
    image = _load(data, name)
    if image.mode == "F":
        raise InputError(f"{name}: expected 8 or 16 bits per channel, found floating-point values; convert the file")
    try:
        turn = _upright_turn(image)
        if turn is not None:
            image = image.transpose(turn)
        if mode == "RGB" and image.mode in ("I;16", "I;16B", "I"):
            image = Image.fromarray((np.asarray(image) >> 8).clip(0, 255).astype(np.uint8))
        image.info.pop("transparency", None)  # the pixels below count, whatever is see-through
        return np.array(image if image.mode == mode else image.convert(mode))
    except BROKEN as error:
        raise _broken(name, error) from error


def _load(data: bytes, name: str) -> Image.Image:
    """The image with its pixels. A TIFF turns itself upright while it is loaded and forgets its orientation."""
    image = _open(data, name)
    try:
        if image.format == "PNG":
            _open(data, name).verify()  # checksums of the chunks, which loading the pixels does not look at
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image.load()
    except BROKEN as error:
        raise _broken(name, error) from error
    return image


def _broken(name: str, error: Exception) -> InputError:
    return InputError(f"{name}: image is broken or truncated ({error}); replace or remove the file")


def _open(data: bytes, name: str) -> Image.Image:
    if not data:
        raise InputError(f"{name}: expected an image, found an empty file; replace or remove it")
    try:
        with warnings.catch_warnings():  # our own bound follows
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=FORMATS)
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{name}: its header tells of more pixels than a camera's; at most {MAX_IMAGE_PIXELS:,} are read; scale it"
        ) from error
    except BROKEN as error:
        raise InputError(
            f"{name}: expected an image ({', '.join(FORMATS)}), found something else or a broken header "
            f"(it begins with {data[:12]!r}); replace or remove the file"
        ) from error
    if image.width < 1 or image.height < 1:
        raise InputError(f"{name}: expected an image, found one of {image.width} x {image.height} pixels; replace it")
    if image.width * image.height > MAX_IMAGE_PIXELS:
        raise InputError(
            f"{name}: {image.width} x {image.height} pixels; at most {MAX_IMAGE_PIXELS:,} are read; scale it"
        )
    return image


def _upright_turn(image: Image.Image) -> Image.Transpose | None:
    """What turns the stored pixels upright by their EXIF orientation; broken EXIF counts as none."""
    try:
        return TURNS.get(image.getexif().get(0x0112, 1))
    except BROKEN:
        return None


@contextmanager
def no_ghostscript() -> Iterator[None]:
    """Pillow starts no program in this block, whatever images a library opens there by itself."""
    before, EpsImagePlugin.gs_binary = EpsImagePlugin.gs_binary, False
    try:
        yield
    finally:
        EpsImagePlugin.gs_binary = before


def image_size(data: bytes, *, name: str) -> tuple[int, int]:
    """(width, height) as `decode_image` gives it, EXIF orientation applied, without decoding the pixels."""
    image = _open(data, name)
    width, height = (image.tag_v2[256], image.tag_v2[257]) if isinstance(image, TiffImageFile) else image.size
    return (height, width) if _upright_turn(image) in SIDEWAYS else (width, height)


def read_image(path: Path | str, *, mode: str = "RGB") -> UInt8[np.ndarray, "height width *channels"]:
    """`decode_image` of a file."""
    return decode_image(read_image_file(path), name=str(path), mode=mode)


def read_image_file(path: Path | str) -> bytes:
    """An encoded image as stored; `InputError` when it cannot be read or is larger than any image that is."""
    return read_bounded(path, "image", max_bytes=MAX_IMAGE_BYTES)


def encode_png(pixels: Shaped[np.ndarray, "height width *channels"]) -> bytes:
    """PNG bytes of an 8-bit (grey or RGB) or 16-bit (grey) array."""
    assert pixels.dtype in (np.uint8, np.uint16), pixels.dtype
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=6)
    return buffer.getvalue()


def encode_jpeg(pixels: UInt8[np.ndarray, "height width 3"], *, quality: int) -> bytes:
    """JPEG bytes with 4:2:0 chroma, as cameras write them."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def write_png(path: Path | str, pixels: Shaped[np.ndarray, "height width *channels"]) -> None:
    """Write an array as PNG, atomically."""
    write_bytes(path, encode_png(pixels))


def encode_depth(depth_m: Float[np.ndarray, "height width"]) -> bytes:
    """16-bit PNG in steps of 1/256 m; non-finite or non-positive depth becomes 0 ("none")."""
    steps = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m * DEPTH_STEPS_PER_METRE, 0.0)
    return encode_png(np.clip(np.round(steps), 0, 65535).astype(np.uint16))


def decode_depth(data: bytes, *, name: str) -> Float[np.ndarray, "height width"]:
    """Metres, NaN where there is no depth."""
    image = _load(data, name)
    if image.mode not in ("I;16", "I;16B", "I"):  # older Pillow opens 16-bit PNG as "I"
        raise InputError(f"{name}: expected a 16-bit grey depth image, found mode {image.mode}")
    steps = np.array(image).astype(np.float32)
    return np.where(steps > 0, steps / DEPTH_STEPS_PER_METRE, np.nan).astype(np.float32)


def to_uint8(rgb: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """[0, 1] floats to 8 bit, rounded, clipped."""
    return np.clip(np.round(rgb * 255.0), 0, 255).astype(np.uint8)
