"""Ground planes, shadows and background depth, each against another way to the same number."""

import numpy as np
import pytest
import torch

from carstudio.errors import InputError
from carstudio.geometry.camera import Camera
from carstudio.scene.background_depth import align_depth, background_depth, densified, hiding_depth, is_ground
from carstudio.scene.footprint import body_mask, ground_rectangle, outline_mask
from carstudio.scene.graph import FileRef, PlacedBox, SceneFrame
from carstudio.scene.ground import Ground, find_ground, ground_from_points, unproject_pixels
from carstudio.scene.lidar import background_points, inside_box, sparse_depth, without_ghosts
from carstudio.scene.shadow import DARKEST, SOFTNESS_M, contact_shadow
from scene.toy_log import HEIGHT_M, placed

CAMERA = Camera(torch.tensor([120.0, 120.0, 80.0, 40.0]), 160, 96)
LEVEL = Ground((0.0, 1.0, 0.0), HEIGHT_M, "test")


def plane_points(normal: np.ndarray, height: float, count: int = 3000) -> np.ndarray:
    random = np.random.default_rng(1)
    x, z = random.uniform(-10, 10, count), random.uniform(3, 40, count)
    y = (height - normal[0] * x - normal[2] * z) / normal[1]
    return np.stack([x, y + random.normal(0, 0.03, count), z], axis=1)


def test_ransac_finds_the_plane_under_clutter():
    normal = np.array([0.02, 1.0, -0.03])
    normal /= np.linalg.norm(normal)
    clutter = np.random.default_rng(2).uniform([-10, 0.4, 3], [10, 1.4, 40], (1500, 3))
    ground = ground_from_points(np.concatenate([plane_points(normal, 1.7), clutter]))
    assert ground is not None
    assert ground.height_m == pytest.approx(1.7, abs=0.02)
    assert np.degrees(np.arccos(np.array(ground.normal) @ normal)) < 0.2


def test_a_wall_or_a_few_points_are_no_ground():
    wall = np.random.default_rng(2).uniform([-10, 0.4, 20.0], [10, 3.0, 20.05], (3000, 3))
    assert ground_from_points(wall) is None
    assert ground_from_points(plane_points(np.array([0.0, 1.0, 0.0]), 1.6)[:100]) is None


def test_boxes_then_the_camera_height_stand_in():
    boxes = [placed(x, z) for x, z in ((-3.0, 8.0), (2.5, 15.0), (-3.0, 30.0), (4.0, 22.0))]
    ground = find_ground(None, [*boxes, placed(3.0, 12.0, lift=1.0)])  # one label floats: it hardly counts
    assert ground.source == "boxes"
    assert float(ground.height_of(np.array([0.0, HEIGHT_M, 15.0]))) == pytest.approx(0.0, abs=0.1)
    assert find_ground(None, []).source == "camera height"


def test_depth_of_the_ground_lies_on_the_plane():
    ground = Ground((0.0199, 0.9994, -0.0298), 1.7, "test")
    depth = ground.depth(CAMERA)
    rows, columns = np.nonzero(np.isfinite(depth) & (depth < 100))
    heights = ground.height_of(unproject_pixels(CAMERA, rows, columns, depth[rows, columns]))
    assert np.abs(heights).max() < 1e-6
    assert not np.isfinite(depth[:20]).any()  # the sky


def test_the_shadow_is_the_rectangle_blurred():
    """Against the mean of a sharp rectangle over random offsets of the same softness."""
    box = placed(1.0, 9.0, -1.2)
    rectangle = ground_rectangle(box, LEVEL)
    shade = contact_shadow(rectangle, LEVEL, CAMERA)
    rows, columns = np.nonzero(shade > 0.02)
    pick = np.random.default_rng(0).permutation(len(rows))[:60]
    points = unproject_pixels(CAMERA, rows[pick], columns[pick], LEVEL.depth(CAMERA)[rows[pick], columns[pick]])
    offset = points - rectangle.center
    jitter = np.random.default_rng(1).normal(0, SOFTNESS_M, (20_000, 2))
    for i, (row, column) in enumerate(zip(rows[pick], columns[pick], strict=True)):
        along, across = offset[i] @ rectangle.along + jitter[:, 0], offset[i] @ rectangle.across + jitter[:, 1]
        share = float(((np.abs(along) < 2.0) & (np.abs(across) < 0.9)).mean())
        assert shade[row, column] == pytest.approx(DARKEST * share, abs=0.02)  # Monte Carlo's error


def test_a_car_in_the_air_has_less_shadow_and_none_far_away():
    dark = contact_shadow(ground_rectangle(placed(0.0, 9.0), LEVEL), LEVEL, CAMERA)
    light = contact_shadow(ground_rectangle(placed(0.0, 9.0, lift=1.0), LEVEL), LEVEL, CAMERA)
    assert dark.max() == pytest.approx(DARKEST, abs=0.01)
    assert 0 < light.max() < 0.1
    assert not dark[:41].any()
    assert contact_shadow(ground_rectangle(placed(0.0, -9.0), LEVEL), LEVEL, CAMERA).max() == 0


def test_lidar_is_thickened_from_near_to_far_and_not_beyond():
    sparse = np.full((60, 60), np.inf)
    sparse[::4, 10:50:4] = 30.0
    sparse[20:40, 28:32] = 8.0  # a pole
    dense = densified(sparse)
    assert dense[30, 30] == pytest.approx(8.0, rel=1e-5)
    assert dense[30, 20] == pytest.approx(30.0, rel=1e-5)
    assert not np.isfinite(densified(np.full((40, 40), np.inf))).any()


def test_depth_of_the_background_takes_the_best_there_is():
    network = np.full((96, 160), 20.0)
    gone = outline_mask(placed(0.0, 10.0), CAMERA)
    nothing = background_depth(CAMERA, LEVEL, points=None, network=None, solid=(), gone=gone)
    assert nothing[90, 80] == pytest.approx(HEIGHT_M * 120 / 50.5)
    assert not np.isfinite(nothing[5, 80])
    boxes = background_depth(CAMERA, LEVEL, points=None, network=None, solid=(placed(0.0, 10.0),), gone=gone & False)
    assert boxes[50, 80] == pytest.approx(8.0)  # the box's near face
    learned = background_depth(CAMERA, LEVEL, points=None, network=network, solid=(), gone=gone)
    assert learned[5, 80] == 20.0
    assert learned[55, 80] != 20.0  # where a car has gone the network saw that car
    wall = np.stack(np.meshgrid(np.linspace(-3, 3, 80), np.linspace(-1, 1, 60), 12.0), axis=-1).reshape(-1, 3)
    scanned = background_depth(CAMERA, LEVEL, points=wall, network=network, solid=(), gone=gone)
    assert scanned[38, 80] == pytest.approx(12.0, rel=1e-5)


def test_ground_lets_wheels_in_and_walls_do_not():
    depth = LEVEL.depth(CAMERA)
    assert is_ground(depth, LEVEL, CAMERA)[60:].all()
    assert (hiding_depth(depth, LEVEL, CAMERA)[60:] > depth[60:] * 1.1).all()
    wall = np.full(depth.shape, 5.0)
    np.testing.assert_allclose(hiding_depth(wall, LEVEL, CAMERA)[:60], 5.35)  # 3 % and 0.2 m of slack


def test_a_networks_scale_and_shift_are_found_among_outliers():
    random = np.random.default_rng(0)
    truth = random.uniform(5, 60, (40, 50))
    inverse = (1 / truth - 0.01) / 0.37
    known = np.where(random.random((40, 50)) < 0.3, truth, np.inf)
    known[::7, ::7] = 3.0  # wrong points
    np.testing.assert_allclose(align_depth(inverse, known), truth, rtol=0.02)
    assert not np.isfinite(align_depth(-inverse, known)).any()  # a network that has it the wrong way round
    assert not np.isfinite(align_depth(inverse, np.full((40, 50), np.inf))).any()


def frame_with_scan(root, points: np.ndarray) -> SceneFrame:
    (root / "velodyne").mkdir(exist_ok=True)
    scan = np.concatenate([points, np.zeros((len(points), 1))], axis=1).astype("<f4")
    (root / "velodyne" / "0.bin").write_bytes(scan.tobytes())
    lidar, identity = FileRef("velodyne/0.bin", ""), tuple(tuple(row) for row in np.eye(4).tolist())
    return SceneFrame(
        index=0, name="000000", image=FileRef("x.png", ""), width=160, height=96, intrinsics=(120.0, 120.0, 80.0, 40.0),
        lidar=lidar, camera_from_lidar=identity, world_from_camera=identity,
    )  # fmt: skip


def test_points_of_a_car_that_has_gone_are_no_background(tmp_path):
    box = placed(1.0, 9.0)
    random = np.random.default_rng(0)
    car = np.array(box.center) + random.uniform(-0.45, 0.45, (200, 3)) * np.array([1.8, 1.5, 4.0])
    beside = np.array([[1.0, 0.5, 6.8], [1.0, 0.2, 20.0], [-4.0, 1.0, 9.0]])  # a stray point of the car, a wall, a kerb
    frame = frame_with_scan(tmp_path, np.concatenate([car, beside]))
    points = background_points(str(tmp_path), frame, [box], ())
    assert points is not None
    np.testing.assert_allclose(points, beside[1:], atol=1e-5)
    assert inside_box(car, box).all()
    assert len(without_ghosts(beside, [], CAMERA)) == 3


def test_a_broken_scan_is_named(tmp_path):
    frame = frame_with_scan(tmp_path, np.ones((3, 3)))
    (tmp_path / "velodyne" / "0.bin").write_bytes(b"123456789")
    with pytest.raises(InputError, match=r"0\.bin: expected points of 16 bytes"):
        background_points(str(tmp_path), frame, [], ())


def test_sparse_depth_keeps_the_nearest_point_of_a_pixel():
    points = np.array([[0.01, 0.01, 10.0], [0.02, 0.02, 12.0], [500.0, 0.0, 1.0]])
    depth = sparse_depth(points, CAMERA)
    assert depth[40, 80] == 10.0
    assert np.isfinite(depth).sum() == 1


def test_a_body_is_smaller_than_its_box_unless_it_is_a_van():
    car, van = placed(2.0, 8.0, -1.0), PlacedBox((2.0, 0.6, 8.0), (5.0, 2.4, 2.0), placed().rotation)
    assert 0.7 < body_mask(car, CAMERA).sum() / outline_mask(car, CAMERA).sum() < 0.99
    assert (outline_mask(car, CAMERA) | ~body_mask(car, CAMERA)).all()
    np.testing.assert_array_equal(body_mask(van, CAMERA), outline_mask(van, CAMERA))
