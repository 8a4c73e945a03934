"""Real KITTI labels: the envelope of a projected 3-D box must be the 2-D box a person drew."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.geometry.box3d import box_from_kitti, envelope
from carstudio.geometry.camera import Camera, camera_offset_from_projection
from carstudio.geometry.overlap import box2d_iou

# A box labelled in 3-D and one drawn in the picture agree this well on every whole car.
LEAST_IOU = 0.957
MIN_HEIGHT_PX = 25  # KITTI's own limit for its hard class; below it a pixel of labelling noise is a large share
UNKNOWN_OCCLUSION = 3


def read_projection(path: Path) -> torch.Tensor:
    for line in path.read_text().splitlines():
        key, _, numbers = line.partition(" ")
        if key.rstrip(":") == "P2":
            return torch.tensor([float(x) for x in numbers.split()], dtype=torch.float64).reshape(3, 4)
    raise AssertionError(f"{path}: no P2")


def whole_cars(data: Path) -> list[tuple[torch.Tensor, list[float], tuple[int, int]]]:
    """(P2, the 14 numbers after the type, image size) of every untruncated car of both benchmarks."""
    cars = []
    mot, det = data / "kitti-mot" / "training", data / "kitti-obj" / "training"
    projection = read_projection(mot / "calib" / "0001.txt")
    for row in csv.reader((mot / "label_02" / "0001.txt").open(), delimiter=" "):
        if row[2] == "Car":
            cars.append((projection, [float(x) for x in row[3:17]], (1242, 375)))
    for path in sorted((det / "label_2").glob("*.txt")):
        projection = read_projection(det / "calib" / path.name)
        for row in csv.reader(path.open(), delimiter=" "):
            if row[0] == "Car":
                cars.append((projection, [float(x) for x in row[1:15]], (1242, 375)))
    return [car for car in cars if car[1][0] == 0 and car[1][1] < UNKNOWN_OCCLUSION]


def envelope_ious(data: Path, *, with_offset: bool) -> np.ndarray:
    ious = []
    for projection, numbers, (width, height) in whole_cars(data):
        _, _, _, x0, y0, x1, y1, car_height, car_width, car_length, x, y, z, yaw = numbers
        if y1 - y0 < MIN_HEIGHT_PX:
            continue
        camera = Camera(projection[[0, 1, 0, 1], [0, 1, 2, 2]], width, height)
        offset = camera_offset_from_projection(projection) if with_offset else None
        size = torch.tensor([car_length, car_height, car_width], dtype=torch.float64)
        bottom, angle = torch.tensor([x, y, z], dtype=torch.float64), torch.tensor(yaw, dtype=torch.float64)
        outline = envelope(box_from_kitti(bottom, size, angle, offset), camera)
        assert outline is not None
        ious.append(box2d_iou(outline, torch.tensor([x0, y0, x1, y1], dtype=torch.float64)).item())
    return np.array(ious)


def test_projected_boxes_are_the_boxes_drawn_in_the_picture(test_data):
    ious = envelope_ious(test_data, with_offset=True)
    assert len(ious) >= 200
    assert ious.min() >= LEAST_IOU


def test_without_the_cameras_offset_they_are_visibly_worse(test_data):
    exact, released = envelope_ious(test_data, with_offset=True), envelope_ious(test_data, with_offset=False)
    assert released.mean() < exact.mean() - 0.02
    assert (released < exact).all()


def test_calibration_gives_the_known_offset(test_data):
    projection = read_projection(test_data / "kitti-mot" / "training" / "calib" / "0001.txt")
    offset = camera_offset_from_projection(projection)
    assert offset.tolist() == pytest.approx([0.0598, -0.0004, 0.0027], abs=5e-5)
