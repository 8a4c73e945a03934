"""Boxes and masks are drawn where the projection says, to the pixel; what is not drawn on stays as it was."""

import numpy as np
import pytest
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.geometry.box3d import CUBE_CORNERS, Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box
from carstudio.geometry.transforms import rotation_y
from carstudio.report.colours import CYAN, GREEN, GREY, ORANGE, PINK
from carstudio.report.overlays import draw_box2d, draw_box3d, draw_mask, faces_camera, visible_edges

CAMERA = Camera(torch.tensor([310.0, 290.0, 140.0, 90.0]), 240, 200)


def black(camera: Camera = CAMERA) -> np.ndarray:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


def box_at(x: float, y: float, z: float, yaw: float) -> Box3D:
    return Box3D(torch.tensor([x, y, z]), torch.tensor([4.2, 1.5, 1.8]), rotation_y(torch.tensor(yaw)))


def corners_by_numpy(box: Box3D, camera: Camera = CAMERA) -> np.ndarray:
    """Image positions of the corners, one at a time in float64, pixel centres at +0.5."""
    fx, fy, cx, cy = camera.intrinsics.double().numpy()
    positions = []
    for sign in CUBE_CORNERS:
        local = np.array(sign) * box.size.double().numpy() / 2
        x, y, z = box.rotation.double().numpy() @ local + box.center.double().numpy()
        positions.append((fx * x / z + cx, fy * y / z + cy))
    return np.array(positions)


def ink_near(picture: np.ndarray, u: float, v: float) -> int:
    """Brightest channel within the pixel that holds (u, v) and those that touch it within half a pixel."""
    columns = {int(np.floor(u + d)) for d in (-0.5, 0.5)}
    rows = {int(np.floor(v + d)) for d in (-0.5, 0.5)}
    return max(int(picture[row, column].max()) for row in rows for column in columns)


@pytest.mark.parametrize("yaw", [0.3, 1.9, -2.2])
def test_every_corner_is_drawn_where_the_projection_says(yaw: float) -> None:
    box = box_at(-0.4, 0.3, 11.0, yaw)
    drawn = draw_box3d(black(), box, CAMERA)
    for u, v in corners_by_numpy(box):
        assert ink_near(drawn, u, v) > 120


def test_the_wireframe_fills_its_outline_and_no_more() -> None:
    box = box_at(0.2, 0.2, 10.0, 0.7)
    rows, columns = np.nonzero(draw_box3d(black(), box, CAMERA).max(axis=-1) > 60)
    positions = corners_by_numpy(box)
    for ink, low, high in ((columns, *_ends(positions[:, 0])), (rows, *_ends(positions[:, 1]))):
        assert abs(ink.min() + 0.5 - low) < 1.0  # a line is a pixel wide: centre within one of the end
        assert abs(ink.max() + 0.5 - high) < 1.0


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def test_lines_lie_on_the_pixels_they_pass_the_middle_of() -> None:
    """A rectangle through pixel centres: full ink on these pixels, the smoothing's rest equal on both sides."""
    drawn = draw_box2d(black(), (10.5, 20.5, 40.5, 60.5)).astype(float) / np.array(PINK)
    across = [drawn[18:23, 25], drawn[58:63, 25], drawn[40, 8:13], drawn[40, 38:43]]
    for line in across:
        assert (line[2] > 0.85).all()
        assert (line[[0, 4]] == 0).all()
        assert (line[[1, 3]] < 0.3).all()
        assert np.abs(line[1] - line[3]).max() < 0.06
    assert not drawn[25:55, 15:35].any()


def test_front_edges_are_orange_the_rest_is_cyan() -> None:
    box = box_at(0.0, 0.2, 10.0, 0.5)
    drawn = draw_box3d(black(), box, CAMERA).astype(int)
    edges = {(i, j): positions.mean(dim=0) for i, j, positions in visible_edges(box, CAMERA)}
    assert len(edges) == 12
    for (i, j), (u, v) in edges.items():
        pixel = drawn[int(v), int(u)]
        near = drawn[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2].reshape(-1, 3)
        wanted = ORANGE if min(i, j) >= 4 else CYAN
        assert np.abs(near - np.array(wanted)).sum(axis=1).min() < 150, (i, j, pixel)


@pytest.mark.parametrize("azimuth_deg", range(-170, 181, 35))
def test_the_front_is_tinted_where_it_could_be_seen(azimuth_deg: int) -> None:
    """From 9 m the front face of a 4.2 m car is seen while cos(azimuth) > 2.1 / 9 (level camera)."""
    box = orbit_box(torch.tensor([4.2, 1.5, 1.8]), azimuth_deg=float(azimuth_deg), elevation_deg=0.0, distance_m=9.0)
    is_seen = np.cos(np.radians(azimuth_deg)) > 2.1 / 9
    assert faces_camera(box) is bool(is_seen)


@pytest.mark.parametrize("yaw", [np.pi / 2, -np.pi / 2, 2.5, 0.4])
def test_a_box_that_passes_the_camera_is_cut_not_turned_over(yaw: float) -> None:
    """Beside the camera, half of it behind: every drawn end is a point of the edge in front of the camera."""
    box = box_at(1.5, 0.5, 0.3, yaw)
    edges = visible_edges(box, CAMERA)
    assert 0 < len(edges) < 12
    corners = box.corners()
    for i, j, positions in edges:
        a, b = corners[i], corners[j]
        for u, v in positions:
            ray = torch.stack([(u - 140.0) / 310.0, (v - 90.0) / 290.0, torch.tensor(1.0)])
            # the ray meets the edge's line at t (b - a) + a with z >= 0.1
            solved = torch.linalg.lstsq(torch.stack([ray, a - b], dim=1), a[:, None])
            z, t = solved.solution.flatten().tolist()
            assert z > 0.0999
            assert -1e-3 < t < 1.001
    behind = box_at(0.0, 0.5, -10.0, 0.0)
    assert visible_edges(behind, CAMERA) == []
    assert not draw_box3d(black(), behind, CAMERA).any()


def test_masks_are_tinted_outlined_and_striped() -> None:
    photo = np.full((40, 60, 3), 100, np.uint8)
    mask = np.full((40, 60), MaskValue.BACKGROUND, np.uint8)
    mask[10:30, 10:40] = MaskValue.CAR
    mask[5:35, 45:55] = MaskValue.UNKNOWN
    drawn = draw_mask(photo, mask)
    assert (photo == 100).all()  # a new picture is returned
    assert (drawn[mask == MaskValue.BACKGROUND] == 100).all()
    inside = np.round(100 * 0.6 + np.array(GREEN) * 0.4)
    assert (drawn[11:29, 11:39] == inside).all()
    edge = np.zeros_like(mask, bool)
    edge[10:30, 10:40] = True
    edge[11:29, 11:39] = False
    assert (drawn[edge] == GREEN).all()
    striped = (drawn[mask == MaskValue.UNKNOWN] != 100).any(axis=1)
    assert 0.4 < striped.mean() < 0.6
    assert (drawn[mask == MaskValue.UNKNOWN][striped] == np.round(100 * 0.6 + np.array(GREY) * 0.4)).all()


def test_a_camera_of_another_image_is_our_mistake() -> None:
    with pytest.raises(AssertionError, match="another size"):
        draw_box3d(np.zeros((50, 50, 3), np.uint8), box_at(0.0, 0.0, 10.0, 0.0), CAMERA)
