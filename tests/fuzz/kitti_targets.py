"""Targets: label lines (detection and tracking), calibrations, and a whole frame on its way to records."""

import json
import math
from contextlib import suppress
from pathlib import Path

import numpy as np

from carstudio.dataset.plans import FrameJob
from carstudio.dataset.recognition import Perception
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_format import (
    KittiLabel,
    center_in_camera,
    group_tracking_lines,
    parse_calibration,
    parse_label,
    parse_labels,
)
from carstudio.dataset.verify import record_problems
from carstudio.errors import InputError
from carstudio.images import encode_png
from carstudio.perception.grabcut import GrabCutSegmenter
from fuzz.edits import Files
from fuzz.target import Target, write_files

LABELS = b"""Car 0.34 1 -1.57 600.0 170.5 700.0 250.25 1.5 1.7 4.2 2.0 1.65 20.0 -1.4
Van 0.00 0 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57 0.98

DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10
Pedestrian 0 3 -0.2 712.40 143.00 810.73 307.92 1.89 0.48 1.20 1.84 1.47 8.41 0.01
"""
TRACKING = b"\n".join(b"%d %d %s" % (i // 2, i - 1, line) for i, line in enumerate(LABELS.splitlines()) if line)
CALIBRATION = b"""P0: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
P2: 7.215377e+02 0 6.095593e+02 4.485728e+01 0 7.215377e+02 1.72854e+02 2.163791e-01 0 0 1 2.745884e-03
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 1 0 0 0 0 1 0 0 0 0 1 0
"""
SMALL_CALIBRATION = b"P2: 40 0 24 1.8 0 40 12 0.01 0 0 1 0.001\n"
SMALL_LABELS = b"""Car 0 0 -1.2 5 4 30 20 1.5 1.8 4.0 0.1 1.0 6.0 -1.2
Car 0 0 -1.2 20 6 40 18 1.5 1.8 4.0 1.1 1.0 9.0 -1.2
Van 0 0 -1.2 1 6 12 18 1.5 1.8 4.0 -3.1 1.0 4.0 -1.2
"""


def _all_finite(*values: float | None) -> bool:
    return all(value is None or math.isfinite(value) for value in values)


def check_label(label: KittiLabel) -> None:
    """What every parsed label promises."""
    x0, y0, x1, y1 = label.box2d
    assert _all_finite(*label.box2d, label.truncation, label.yaw_rad, label.score), label
    assert x0 < x1, label
    assert y0 < y1, label
    assert label.occlusion in (None, 0, 1, 2), label
    assert (label.size is None) == (label.bottom_center is None), label
    if label.size is not None:
        assert min(label.size) > 0, label
    center = center_in_camera(label, (0.06, 0.0, 0.003))
    assert _all_finite(*(label.size or ()), *(center or ())), label


def read_labels(files: Files, folder: Path) -> None:
    """A label file of the detection or of the tracking set."""
    if "tracking.txt" in files:
        frames, problems = group_tracking_lines(files["tracking.txt"].decode(errors="replace"), name="0000.txt")
        assert all("0000.txt line " in problem for problem in problems)
        for line in (line for lines in frames.values() for line in lines):
            with suppress(InputError):  # the other lines are read all the same
                check_label(parse_label(line.rest, where=line.where))
        return
    text = files["label.txt"].decode(errors="replace")
    for number, line in enumerate(text.split("\n"), start=1):
        with suppress(InputError):
            check_label(parse_label(line, where=f"label.txt line {number}"))
    for label in parse_labels(text, name="label.txt"):
        check_label(label)


def read_calibration(files: Files, folder: Path) -> None:
    """A camera that can project."""
    calibration = parse_calibration(files["calib.txt"].decode(errors="replace"), name="calib.txt")
    assert _all_finite(*calibration.intrinsics, *calibration.camera_offset), calibration
    assert min(calibration.intrinsics[:2]) > 0, calibration


def frame_seeds() -> list[Files]:
    """One frame of KITTI-DET with three objects."""
    pixels = np.random.default_rng(0).integers(0, 256, (24, 48, 3), dtype=np.uint8)
    return [
        {
            "image_2/000000.png": encode_png(pixels),
            "label_2/000000.txt": SMALL_LABELS,
            "calib/000000.txt": SMALL_CALIBRATION,
        }
    ]


def read_frame(files: Files, folder: Path) -> None:
    """A frame on its way through the build: sound records and problems in words."""
    write_files(files, folder)
    source = open_kitti_det(folder)
    result = FrameJob(source, Perception(GrabCutSegmenter()), ("Car",), frozenset())(source.refs[:1])
    for record in result.records:
        assert record_problems(record) == [], (record, record_problems(record))
        assert isinstance(json.loads(record.extra), dict)
    assert all(isinstance(problem, str) and problem for problem in result.problems)


KITTI_TARGETS = (
    Target("labels", lambda: [{"label.txt": LABELS}, {"tracking.txt": TRACKING}], read_labels),
    Target("calibration", lambda: [{"calib.txt": CALIBRATION}, {"calib.txt": SMALL_CALIBRATION}], read_calibration),
    Target("frame", frame_seeds, read_frame),
)
