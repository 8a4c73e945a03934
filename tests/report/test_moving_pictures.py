"""Frames go in, the same frames come out: count, order, duration, size and colour, GIF and MP4."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from carstudio.errors import InputError
from carstudio.report import video
from carstudio.report.video import count_frames, write_gif, write_mp4


def marked_frames(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """A white bar that wanders to the right on a coloured ground: its place tells the frame's number."""
    frames = []
    for number in range(count):
        frame = np.full((height, width, 3), (200, 40, 40) if number % 2 else (40, 60, 190), np.uint8)
        frame[:, 4 * number : 4 * number + 4] = 255
        frames.append(frame)
    return frames


def bar_at(frame: np.ndarray) -> int:
    """Number of the frame by its bar."""
    return int(np.argmax(frame.astype(int).sum(axis=(0, 2)))) // 4


@pytest.mark.parametrize(("fps", "duration_ms"), [(10.0, 100), (12.0, 80), (25.0, 40), (60.0, 20), (1000.0, 20)])
def test_a_gif_holds_its_frames_for_their_time(fps: float, duration_ms: int, tmp_path: Path) -> None:
    frames = marked_frames(9)
    write_gif(tmp_path / "a.gif", frames, fps)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.info["loop"] == 0  # for ever
        durations, seen = [], []
        for frame in ImageSequence.Iterator(image):
            durations.append(frame.info["duration"])
            seen.append(np.array(frame.convert("RGB")))
    assert durations == [duration_ms] * 9
    assert [bar_at(frame) for frame in seen] == list(range(9))
    assert max(np.abs(a.astype(int) - b).max() for a, b in zip(frames, seen, strict=True)) <= 8  # 256 colours


def test_one_palette_serves_all_frames(tmp_path: Path) -> None:
    """A still corner of many colours in a film of changing ones stays as it is to the bit."""
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (40, 40, 3), dtype=np.uint8) for _ in range(6)]
    for frame in frames:
        frame[:20, :20] = frames[0][:20, :20]
    write_gif(tmp_path / "a.gif", frames, 10.0)
    with Image.open(tmp_path / "a.gif") as image:
        corners = {np.array(frame.convert("RGB"))[:20, :20].tobytes() for frame in ImageSequence.Iterator(image)}
    assert len(corners) == 1


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63)])
def test_an_mp4_holds_its_frames_at_its_rate(height: int, width: int, tmp_path: Path) -> None:
    frames = marked_frames(11, height, width)
    assert write_mp4(tmp_path / "a.mp4", frames, 12.5) in video.CODECS
    reader = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    seen = []
    while (read := reader.read())[0]:
        seen.append(read[1][..., ::-1])
    reader.release()
    assert len(seen) == count_frames(tmp_path / "a.mp4") == 11
    assert all(frame.shape == (48, 64, 3) for frame in seen)  # odd sides gain a pixel
    assert [bar_at(frame) for frame in seen] == list(range(11))
    for mine, theirs in zip(frames, seen, strict=True):  # red is red, blue is blue
        ground = np.median(theirs.reshape(-1, 3), axis=0)
        assert np.abs(ground - mine[0, -1]).max() < 25


def test_a_codec_that_fails_gives_way_to_the_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []
    encode = video._encode

    def first_fails(path: Path, frames: list[np.ndarray], fps: float, codec: str) -> bool:
        tried.append(codec)
        return len(tried) > 1 and encode(path, frames, fps, codec)

    monkeypatch.setattr(video, "_encode", first_fails)
    assert write_mp4(tmp_path / "a.mp4", marked_frames(3), 10.0) == video.CODECS[1]
    assert tried == list(video.CODECS)
    monkeypatch.setattr(video, "_encode", lambda *_: False)
    with pytest.raises(InputError, match=r"b\.mp4: this OpenCV .* write a \.gif"):
        write_mp4(tmp_path / "b.mp4", marked_frames(3), 10.0)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]  # nothing half written stays


def test_an_mp4_is_named_so(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.avi: a video's name must end in \.mp4"):
        write_mp4(tmp_path / "a.avi", marked_frames(2), 10.0)


@pytest.mark.parametrize("write", [write_gif, write_mp4])
def test_no_frame_is_our_mistake(write: object, tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="needs a frame"):
        write(tmp_path / "a.mp4", [], 10.0)  # type: ignore[operator]  # a function, of either kind
