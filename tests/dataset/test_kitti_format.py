"""KITTI's text files: real lines, closed formulas, and a table of broken lines with the messages they give."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.sources.kitti_format import (
    center_in_camera,
    group_tracking_lines,
    parse_calibration,
    parse_label,
    parse_labels,
)
from carstudio.errors import InputError

CAR = "Car 0.34 1 -1.57 600.0 170.5 700.0 250.25 1.5 1.7 4.2 2.0 1.65 20.0 -1.4"
CALIBRATION = """P0: 7 0 6 0 0 7 1 0 0 0 1 0
P2: 7.215377e+02 0 6.095593e+02 4.485728e+01 0 7.215377e+02 1.72854e+02 2.163791e-01 0 0 1 2.745884e-03
R_rect 1 0 0 0 1 0 0 0 1
"""


def test_a_label_line_is_read_in_our_order() -> None:
    label = parse_label(CAR, where="000001.txt line 1")
    assert label.type == "Car"
    assert (label.truncation, label.occlusion) == (0.34, 1)
    assert label.box2d == (600.0, 170.5, 700.0, 250.25)
    assert label.size == (4.2, 1.5, 1.7)  # the file has height, width, length
    assert label.bottom_center == (2.0, 1.65, 20.0)
    assert label.yaw_rad == -1.4
    assert label.score is None
    assert parse_label(CAR + " 0.87", where="x").score == 0.87


def test_unknown_values_become_none() -> None:
    label = parse_label("Car -1 3 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10 0.5", where="x")
    assert (label.truncation, label.occlusion, label.size, label.bottom_center) == (None, None, None, None)
    dont_care = parse_label("DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10", where="x")
    assert dont_care.size is None


def _with(index: int, word: str) -> str:
    words = CAR.split()
    words[index] = word
    return " ".join(words)


BROKEN_LINES = {
    "000123.txt line 4: expected 15 columns (16 with a score) from the type on, found 14": " ".join(CAR.split()[:-1]),
    "000123.txt line 4: expected 15 columns (16 with a score) from the type on, found 17": CAR + " 1 2",
    "000123.txt line 4: height must be a finite number, found 'tall'": _with(8, "tall"),
    "000123.txt line 4: z must be a finite number, found 'nan'": _with(13, "nan"),
    "000123.txt line 4: x must be a finite number, found '1e999'": _with(11, "1e999"),
    "000123.txt line 4: x must lie between -1e+06 and 1e+06, found '-1e300'": _with(11, "-1e300"),
    "000123.txt line 4: rotation_y must be a finite number, found '-inf'": _with(14, "-inf"),
    "000123.txt line 4: box size must be positive (length, height, width) in metres, found (-1.0, 1.5, 1.7)": _with(
        10, "-1.0"
    ),
    "000123.txt line 4: 2-D box must have x0 < x1 and y0 < y1 in px, found (700.0, 170.5, 700.0, 250.25)": _with(
        4, "700.0"
    ),
}


@pytest.mark.parametrize(("message", "line"), BROKEN_LINES.items())
def test_broken_lines_are_explained(message: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_labels(f"{CAR}\n\n{CAR}\n{line}\n", name="000123.txt")
    assert str(caught.value) == message


def test_box_center_agrees_with_the_projection_matrix() -> None:
    """Projecting the camera-frame centre with K alone equals projecting the label-frame centre with all of P2."""
    calibration = parse_calibration(CALIBRATION, name="c")
    label = parse_label(CAR, where="x")
    center = np.array(center_in_camera(label, calibration.camera_offset))
    P2 = np.array([float(word) for word in CALIBRATION.splitlines()[1].split()[1:]]).reshape(3, 4)
    expected = P2 @ np.array([2.0, 1.65 - 1.5 / 2, 20.0, 1.0])
    np.testing.assert_allclose(P2[:, :3] @ center, expected, rtol=1e-12)
    np.testing.assert_allclose(calibration.camera_offset, (0.0598, -0.0004, 0.0027), atol=5e-5)  # by hand
    assert calibration.intrinsics == (721.5377, 721.5377, 609.5593, 172.854)


def test_offset_moves_a_box_by_the_pixels_that_facts_name() -> None:
    x, _, z = parse_calibration(CALIBRATION, name="c").camera_offset
    shifts = [721.5377 * x / (depth + z) for depth in (5.0, 10.0, 20.0)]
    np.testing.assert_allclose(shifts, [8.6, 4.3, 2.2], atol=0.06)


def test_calibration_keys_may_lack_the_colon() -> None:
    assert parse_calibration(CALIBRATION.replace("P2:", "P2"), name="c") == parse_calibration(CALIBRATION, name="c")


BROKEN_CALIBRATIONS = {
    "calib/1.txt: no line P2; expected a KITTI calibration file with P0 to P3": "P0: 1 2 3\n",
    "calib/1.txt line 1: P2 must have 12 numbers (3 x 4, row by row), found 3": "P2: 1 2 3\n",
    "calib/1.txt line 1: number 3 of P2 must be a finite number, found 'x'": "P2: 1 2 x\n",
    "calib/1.txt line 1: P2 must have positive focal lengths, found (0.0, 7.0) px": "P2: 0 0 6 0 0 7 1 0 0 0 1 0\n",
    "calib/1.txt line 1: P2 must have focal lengths in px (hundreds), found (1e-320, 7.0)": (
        "P2: 1e-320 0 6 0 0 7 1 0 0 0 1 0\n"
    ),
    "calib/1.txt line 1: number 12 of P2 must be a finite number, found 'nan'": "P2: 7 0 6 0 0 7 1 0 0 0 1 nan\n",
    "calib/1.txt line 1: number 4 of P2 must lie between -1e+06 and 1e+06, found '1e308'": (
        "P2: 7 0 6 1e308 0 7 1 0 0 0 1 0\n"
    ),
    # its first three columns are singular
    "calib/1.txt line 1: P2 must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
    "7 7 6 0 7 7 6 0 0 0 1 0": "P2: 7 7 6 0 7 7 6 0 0 0 1 0\n",
    # a projection may be scaled: then its entries are no focal lengths
    "calib/1.txt line 1: P2 must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
    "14 0 12 0 0 14 2 0 0 0 2 0": "P2: 14 0 12 0 0 14 2 0 0 0 2 0\n",
}


@pytest.mark.parametrize(("message", "text"), BROKEN_CALIBRATIONS.items())
def test_broken_calibrations_are_explained(message: str, text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_calibration(text, name="calib/1.txt")
    assert str(caught.value) == message


def test_a_tracking_line_without_frame_or_track_costs_only_itself() -> None:
    text = f"0 2 {CAR}\n\nx 2 {CAR}\n1\n0 3 {CAR}\n"
    frames, problems = group_tracking_lines(text, name="label_02/0001.txt")
    assert [(line.track_id, line.where) for line in frames[0]] == [
        (2, "label_02/0001.txt line 1"),
        (3, "label_02/0001.txt line 5"),
    ]
    assert list(frames) == [0]
    assert [problem.split(":")[0] for problem in problems] == ["label_02/0001.txt line 3", "label_02/0001.txt line 4"]


def test_every_label_of_the_real_files_is_read(test_data: Path) -> None:
    """Counts from the text itself: `grep -c` on the files."""
    text = (test_data / "kitti-mot" / "training" / "label_02" / "0001.txt").read_text()
    frames, problems = group_tracking_lines(text, name="0001.txt")
    labels = [parse_label(line.rest, where=line.where) for lines in frames.values() for line in lines]
    assert problems == ()
    assert len(labels) == len(text.splitlines())
    cars = [label for label in labels if label.type == "Car"]
    assert len(cars) == text.count(" Car ") == 234
    alphas = [float(label.line.split()[3]) for label in cars]
    centers = torch.tensor([center_in_camera(label, (0.0, 0.0, 0.0)) for label in cars])
    for label, alpha, (x, _, z) in zip(cars, alphas, centers.tolist(), strict=True):
        # KITTI's alpha is rotation_y seen along the ray: an oracle for columns read in the right order.
        error = (label.yaw_rad - math.atan2(x, z) - alpha + math.pi) % (2 * math.pi) - math.pi
        assert abs(error) < 0.01 + 0.2 / z  # alpha may be rounded to 0.01; its origin lies some cm aside
