import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from carstudio.errors import InputError
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.images import encode_png
from carstudio.report.colours import NO_DEPTH, ORANGE, colour_depth, turbo
from carstudio.report.overlays import draw_box3d
from carstudio.report.page import Commands, Page, Picture, Section, write_page
from carstudio.report.plots import learning_curve, running_mean
from carstudio.report.video import count_frames, write_gif, write_mp4


def frames(count: int) -> list[np.ndarray]:
    return [np.full((24, 32, 3), (10 * i, 200 - 10 * i, 30), np.uint8) for i in range(count)]


def test_turbo_runs_from_dark_blue_over_green_to_dark_red() -> None:
    low, middle, high = turbo(np.array([[0.0, 0.5, 1.0]], np.float32))[0].tolist()
    assert low[2] > low[0]
    assert middle[1] == max(middle)
    assert high[0] > 100 > high[1]


def test_near_is_brighter_than_far_and_nothing_is_almost_black() -> None:
    picture = colour_depth(np.array([[5.0, 10.0, np.nan]], np.float32), near_m=5.0, far_m=10.0)
    assert int(picture[0, 0].astype(int).sum()) > int(picture[0, 1].astype(int).sum())
    assert tuple(picture[0, 2]) == NO_DEPTH


def test_the_wireframes_front_is_at_the_front() -> None:
    """Seen from its right side (azimuth -90) a car faces right: the orange edges lie right of the image's middle."""
    box = orbit_box(torch.tensor([4.2, 1.5, 1.8]), azimuth_deg=-90.0, elevation_deg=10.0, distance_m=10.0)
    drawn = draw_box3d(np.zeros((100, 100, 3), np.uint8), box, orbit_camera(100))
    is_orange = (np.abs(drawn.astype(int) - np.array(ORANGE)) < 30).all(axis=-1)
    assert is_orange.sum() > 5
    assert float(np.nonzero(is_orange)[1].mean()) > 60


def test_moving_pictures_hold_every_frame(tmp_path: Path) -> None:
    write_gif(tmp_path / "a.gif", frames(7), 10.0)
    assert Image.open(tmp_path / "a.gif").n_frames == 7  # type: ignore[attr-defined]
    write_mp4(tmp_path / "a.mp4", frames(7), 10.0)
    assert count_frames(tmp_path / "a.mp4") == 7


def test_the_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    picture = Picture(source=encode_png(frames(1)[0]), caption="<b>a car</b>")
    section = Section(title="One", blocks=[picture, Commands(["carstudio demo"])])
    write_page(tmp_path / "index.html", Page(title="A & B", sections=[section]))
    text = (tmp_path / "index.html").read_text()
    assert not re.findall(r"(?:src|href)\s*=\s*[\"'](?:https?:)?//", text)
    assert "<script" not in text
    assert "&lt;b&gt;a car" in text
    assert "data:image/png;base64," in text


def test_a_page_refuses_pictures_that_are_not_there_or_climb_out(tmp_path: Path) -> None:
    for source in ("missing.png", "../outside.png"):
        page = Page(title="A", sections=[Section(title="One", blocks=[Picture(source=source)])])
        with pytest.raises(InputError):
            write_page(tmp_path / "index.html", page)


def test_curves_are_reproducible_and_smoothing_starts_at_the_first_value() -> None:
    rows = [{"step": i, "loss": 1.0 / (i + 1), "psnr": float(i)} for i in range(30)]
    assert learning_curve(rows) == learning_curve(rows)
    assert running_mean([3.0, 3.0, 3.0]) == pytest.approx([3.0, 3.0, 3.0])
