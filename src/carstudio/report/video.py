"""Turntables and edited drives as moving pictures: GIF for documents, MP4 for players."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from carstudio.errors import InputError
from carstudio.files import atomic_path

# OpenCV's wheels carry no H.264 encoder. VP9 in MP4 plays in today's browsers; MPEG-4 part 2 is for players only.
CODECS = ("vp09", "mp4v")
PALETTE_SAMPLES = 12  # frames that the common palette of a GIF is made from

Pixels = UInt8[np.ndarray, "_h _w 3"]


def write_gif(path: Path | str, frames: Sequence[Pixels], fps: float) -> None:
    """An endless GIF with one palette for all frames (its colours do not flicker), atomically.

    GIF counts in 1/100 s, so the frame rate is rounded to it.
    """
    _check(frames, fps)
    sampled = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, PALETTE_SAMPLES).astype(int))]
    palette = Image.fromarray(np.concatenate(sampled)).quantize(256, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    duration_ms = max(20, round(100 / fps) * 10)  # browsers slow anything quicker down to 100 ms
    with atomic_path(path) as partial:
        images[0].save(
            partial, "GIF", save_all=True, append_images=images[1:], duration=duration_ms, loop=0, optimize=False
        )


def write_mp4(path: Path | str, frames: Sequence[Pixels], fps: float) -> str:
    """An MP4, atomically; returns the codec taken, the first of `CODECS` that works here.

    The file is opened again and its frames are counted before it takes its name. Odd sides gain a repeated edge pixel,
    because the codecs halve the colour resolution. Frames are taken one at a time (again for a second codec), so a
    sequence that reads them from files needs memory for one.
    """
    assert len(frames) > 0, "a moving picture needs a frame"
    assert fps > 0, fps
    if Path(path).suffix != ".mp4":
        raise InputError(f"{path}: a video's name must end in .mp4")
    with atomic_path(path) as partial:
        for codec in CODECS:
            if _encode(partial, frames, fps, codec) and count_frames(partial) == len(frames):
                return codec
        raise InputError(
            f"{path}: this OpenCV ({cv2.__version__}) writes none of {', '.join(CODECS)}; "
            "install opencv-python-headless from its wheel, or write a .gif"
        )


def _encode(path: Path, frames: Sequence[np.ndarray], fps: float, codec: str) -> bool:
    shape = frames[0].shape
    height, width = shape[0] + shape[0] % 2, shape[1] + shape[1] % 2
    fourcc = cv2.VideoWriter.fourcc(codec[0], codec[1], codec[2], codec[3])
    writer = cv2.VideoWriter(str(path), fourcc, fps, (width, height))
    try:
        if not writer.isOpened():
            return False
        for frame in frames:
            assert frame.shape == shape, "all frames must have one size"
            even = np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), "edge")
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
        return True
    finally:
        writer.release()


def count_frames(path: Path | str) -> int:
    """How many frames of a video can be decoded."""
    reader = cv2.VideoCapture(str(path))
    count = 0
    while reader.read()[0]:
        count += 1
    reader.release()
    return count


def _check(frames: Sequence[np.ndarray], fps: float) -> None:
    assert len(frames) > 0, "a moving picture needs a frame"
    assert len({frame.shape for frame in frames}) == 1, "all frames must have one size"
    assert fps > 0, fps
