"""Every drawn position against a projection done by hand: u = fx x / z + cx, drawn in the pixel that holds it."""

import numpy as np
import pytest
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.geometry.box3d import BOX_EDGES, CUBE_CORNERS, Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.report.colours import GREEN, GREY, ORANGE, PINK
from carstudio.report.overlays import draw_box2d, draw_box3d, draw_mask, faces_camera, visible_edges

AWAY, TOWARDS, RIGHT = -np.pi / 2, np.pi / 2, 0.0


def black(height: int = 120, width: int = 160) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def box_at(center: tuple[float, float, float], yaw: float, size: tuple[float, float, float] = (4.0, 1.5, 1.8)) -> Box3D:
    return Box3D(torch.tensor(center), torch.tensor(size), rotation_y(torch.tensor(yaw)))


def tilted(box: Box3D, pitch: float) -> Box3D:
    """Seen by a camera that looks down."""
    c, s = np.cos(pitch), np.sin(pitch)
    pitched = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float32)
    return Box3D(pitched @ box.center, box.size, pitched @ box.rotation)


def corners_by_hand(box: Box3D, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Pixel positions and depths of the eight corners, in float64 from the definition of the car frame."""
    fx, fy, cx, cy = camera.intrinsics.double().tolist()
    rotation, center, half = box.rotation.double().numpy(), box.center.double().numpy(), box.size.double().numpy() / 2
    points = np.stack([rotation @ (np.array(corner) * half) + center for corner in CUBE_CORNERS])
    return np.stack([fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy], -1), points[:, 2]


VIEWS = [
    (box_at((0.5, 0.9, 9.0), -2.2), (150.0, 150.0, 80.0, 60.0)),
    (box_at((-1.0, 0.3, 8.0), 0.4), (130.0, 140.0, 95.5, 52.25)),
    (tilted(box_at((1.5, 1.2, 10.0), 2.6), 0.2), (170.0, 170.0, 33.0, 71.0)),
    (box_at((9.0, 0.4, 12.0), -0.7), (150.0, 150.0, -30.0, 58.0)),  # the principal point lies beside the picture
]


def near_lines(ends: list[tuple[np.ndarray, np.ndarray]], reach_px: float) -> np.ndarray:
    """Pixels whose centre lies within `reach_px` of one of the segments."""
    v, u = np.mgrid[0:120, 0:160] + 0.5
    near = np.zeros(u.shape, bool)
    for a, b in ends:
        along = ((u - a[0]) * (b - a)[0] + (v - a[1]) * (b - a)[1]) / ((b - a) @ (b - a))
        share = np.clip(along, 0, 1)
        near |= np.hypot(u - a[0] - share * (b - a)[0], v - a[1] - share * (b - a)[1]) < reach_px
    return near


@pytest.mark.parametrize(("box", "intrinsics"), VIEWS)
def test_every_edge_is_drawn_where_the_projection_says_and_nothing_else(
    box: Box3D, intrinsics: tuple[float, ...]
) -> None:
    camera = Camera(torch.tensor(intrinsics), 160, 120)
    positions, _ = corners_by_hand(box, camera)
    assert ((positions > 1) & (positions < [159, 119])).all(), "the test wants all of it in view"
    is_drawn = draw_box3d(black(), box, camera).max(axis=-1) > 100  # a smooth line is two to three pixels wide
    edges = [(positions[i], positions[j]) for i, j in BOX_EDGES]
    crossing = [(positions[4], positions[7]), (positions[5], positions[6])]
    assert is_drawn[near_lines(edges, 0.5)].all()
    assert is_drawn[near_lines(crossing, 0.5)].all()
    assert not is_drawn[~near_lines(edges + crossing, 1.5)].any()


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.8])
def test_lines_lie_where_they_should_to_a_tenth_of_a_pixel(shift: float) -> None:
    """The centroid of a line's brightness, pixel centres at +0.5: the rear of a car that drives away."""
    camera = Camera(torch.tensor([100.0, 100.0, 80.0 + shift, 60.0 + shift]), 160, 120)
    drawn = draw_box3d(black(), box_at((0.0, 0.0, 15.0), AWAY, size=(10.0, 2.0, 4.0)), camera)[..., 2].astype(float)
    for u in (60 + shift, 100 + shift):  # 80 +- 100 * 2 / 10
        columns = np.arange(int(u) - 3, int(u) + 4)
        profile = drawn[58:62, columns].mean(axis=0)
        assert profile @ (columns + 0.5) / profile.sum() == pytest.approx(u, abs=0.1)
    for v in (50 + shift, 70 + shift):
        rows = np.arange(int(v) - 2, int(v) + 3)
        profile = drawn[rows, 75:85].mean(axis=1)
        assert profile @ (rows + 0.5) / profile.sum() == pytest.approx(v, abs=0.1)


def test_the_front_is_orange_crossed_and_tinted_only_where_it_faces_us() -> None:
    camera = Camera(torch.tensor([100.0, 100.0, 80.0, 60.0]), 160, 120)
    grey = np.full((120, 160, 3), 100, np.uint8)
    towards, away = (box_at((0.0, 0.0, 12.0), yaw, size=(4.0, 2.0, 4.0)) for yaw in (TOWARDS, AWAY))
    tint = np.round(0.75 * 100 + 0.25 * np.array(ORANGE))
    inside = (slice(58, 62), slice(62, 64))  # between the near face's side at 60 and the far one's at 65.7
    assert np.abs(draw_box3d(grey, towards, camera)[inside] - tint).max() <= 1
    assert (draw_box3d(grey, away, camera)[inside] == 100).all()
    near_side = (slice(58, 62), slice(59, 61))
    red_minus_blue = [
        np.diff(draw_box3d(black(), box, camera)[near_side][..., ::2].astype(int)) for box in (towards, away)
    ]
    assert (red_minus_blue[0] < 0).all()  # orange
    assert (red_minus_blue[1] > 0).all()  # cyan


@pytest.mark.parametrize(("yaw", "faces"), [(TOWARDS, True), (AWAY, False), (RIGHT, False), (RIGHT + 0.6, True)])
def test_which_cars_face_the_camera(yaw: float, faces: bool) -> None:
    """Oracle: the camera's centre in the car frame lies before the front face, by the inverse transform."""
    box = box_at((0.0, 1.0, 9.0), yaw)
    in_car = np.linalg.inv(box.camera_from_car.double().numpy()) @ [0, 0, 0, 1]
    assert (in_car[0] > 2.0) is np.bool_(faces)
    assert faces_camera(box) is faces


def test_edges_behind_the_camera_are_cut_and_nothing_is_drawn_of_a_box_behind() -> None:
    camera = Camera(torch.tensor([100.0, 100.0, 80.0, 60.0]), 160, 120)
    beside = box_at((2.5, 0.5, 0.5), AWAY)
    edges = visible_edges(beside, camera)
    positions, depths = corners_by_hand(beside, camera)
    assert (depths < 0).any()
    assert (depths > 0).any()
    assert {(i, j) for i, j, _ in edges} == {(i, j) for i, j in BOX_EDGES if depths[i] > 0.1 or depths[j] > 0.1}
    for i, j, ends in edges:
        assert torch.isfinite(ends).all()
        for k, end in zip((i, j), ends, strict=True):
            if depths[k] > 0.1:
                np.testing.assert_allclose(end, positions[k], rtol=1e-4)
    assert draw_box3d(black(), beside, camera).any()
    assert visible_edges(box_at((0.0, 0.0, -9.0), 0.3), camera) == []
    assert not draw_box3d(black(), box_at((0.0, 0.0, -9.0), 0.3), camera).any()


def test_nothing_given_is_drawn_upon() -> None:
    camera = Camera(torch.tensor([100.0, 100.0, 80.0, 60.0]), 160, 120)
    picture, mask = black(), np.full((120, 160), MaskValue.CAR, np.uint8)
    draw_box3d(picture, box_at((0.0, 0.0, 9.0), 0.3), camera)
    draw_box2d(picture, (1.0, 2.0, 30.0, 40.0))
    draw_mask(picture, mask)
    assert not picture.any()


def test_a_camera_of_another_size_is_our_mistake() -> None:
    with pytest.raises(AssertionError, match="another size"):
        draw_box3d(black(), box_at((0.0, 0.0, 9.0), 0.3), Camera(torch.tensor([100.0, 100.0, 80.0, 60.0]), 161, 120))


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.8])
def test_a_2d_boxs_sides_lie_on_its_numbers(shift: float) -> None:
    """The centroid of each side's brightness, pixel centres at +0.5."""
    sides = 6 + shift, 5 + shift, 20 + shift, 16 + shift
    drawn = draw_box2d(black(24, 30), sides)[..., 0].astype(float)
    left, top, right, bottom = (
        (part @ (np.arange(len(part)) + 0.5)) / part.sum()
        for part in (drawn[8:14, :13].sum(0), drawn[:10, 9:17].sum(1), drawn[8:14, 13:].sum(0), drawn[10:, 9:17].sum(1))
    )
    assert (left, top, right + 13, bottom + 10) == pytest.approx(sides, abs=0.1)
    assert not drawn[9:13, 10:17].any()
    assert draw_box2d(black(24, 30), sides).max(axis=(0, 1)) == pytest.approx(np.array(PINK), rel=0.35)


def test_a_mask_tints_outlines_and_stripes() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (24, 24, 3)).astype(np.uint8)
    mask = np.zeros((24, 24), np.uint8)
    mask[4:14, 4:14] = MaskValue.CAR
    mask[16:22, :] = MaskValue.UNKNOWN
    drawn = draw_mask(picture, mask, strength=0.25)
    inside = (slice(5, 13), slice(5, 13))
    assert np.abs(drawn[inside] - np.round(0.75 * picture[inside] + 0.25 * np.array(GREEN))).max() <= 1
    rim = mask == MaskValue.CAR
    rim[inside] = False
    assert (drawn[rim] == GREEN).all()
    assert (drawn[mask == MaskValue.BACKGROUND] == picture[mask == MaskValue.BACKGROUND]).all()
    changed = (drawn != picture).any(axis=-1)[16:22]
    assert 0.4 < changed.mean() < 0.6  # every second stripe
    striped = np.round(0.75 * picture[16:22] + 0.25 * np.array(GREY))
    assert np.abs(drawn[16:22] - striped)[changed].max() <= 1


def test_an_empty_mask_changes_nothing() -> None:
    picture = np.full((5, 6, 3), 9, np.uint8)
    assert (draw_mask(picture, np.zeros((5, 6), np.uint8)) == picture).all()
