"""Photographs: mask, depth, box and camera against independent computations; handedness; colours; determinism."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from carstudio.geometry.box3d import envelope
from carstudio.geometry.overlap import box2d_iou
from carstudio.geometry.transforms import rotation_y, yaw_from_rotation
from carstudio.synthetic.cameras import draw_viewpoint, look, viewpoint_at
from carstudio.synthetic.cars import Car
from carstudio.synthetic.photographs import (
    Photograph,
    draw_azimuths,
    draw_photographs,
    draw_scene,
    exact_truth,
    picture,
)
from carstudio.synthetic.surfaces import CarMesh
from carstudio.synthetic.tracing import Tracer
from oracles.triangles import first_hit


def test_every_mask_lies_in_the_envelope_of_its_box(photographs: list[Photograph], red_car: Car) -> None:
    for photo in photographs:
        outline = envelope(photo.viewpoint.box(red_car.mesh), photo.viewpoint.camera)
        assert outline is not None
        rows, columns = np.nonzero(photo.mask)
        box = torch.tensor([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], dtype=torch.float32)
        # pixel (u, v) is car when its centre (u + 0.5, v + 0.5) is
        assert bool((box[:2] + 0.5 >= outline[:2]).all())
        assert bool((box[2:] - 0.5 <= outline[2:]).all())
        assert float(box2d_iou(outline, box)) > 0.6


def test_masks_reach_the_projected_vertices(photographs: list[Photograph], red_car: Car) -> None:
    """numpy projection of the vertices: the mask's bounding box touches theirs to within a pixel."""
    for photo in photographs:
        fx, fy, cx, cy = photo.viewpoint.camera.intrinsics.double().numpy()
        x, y, z = (red_car.mesh.vertices @ photo.viewpoint.rotation.T + photo.viewpoint.translation).T
        u, v = fx * x / z + cx, fy * y / z + cy
        rows, columns = np.nonzero(photo.mask)
        assert 0 <= u.min() - 0.5 + 1e-3 or columns.min() == 0
        assert abs(columns.min() - (u.min() - 0.5)) < 1.6
        assert abs(columns.max() - (u.max() - 0.5)) < 1.6
        assert abs(rows.min() - (v.min() - 0.5)) < 1.6
        assert abs(rows.max() - (v.max() - 0.5)) < 1.6
        extent = max(u.max() - u.min(), v.max() - v.min()) / photo.viewpoint.camera.width
        assert 0.69 < extent < 0.96
        assert u.min() > 0
        assert u.max() < photo.viewpoint.camera.width


def test_depth_is_that_of_brute_force(photographs: list[Photograph], red_car: Car) -> None:
    """Every triangle against a few rays in float64 (Moeller-Trumbore)."""
    photo = photographs[0]
    rng = np.random.default_rng(0)
    rows, columns = np.nonzero(photo.mask)
    inner = rng.choice(len(rows), 12, replace=False)
    beside = np.argwhere(~photo.mask)[rng.choice((~photo.mask).sum(), 6, replace=False)]
    fx, fy, cx, cy = photo.viewpoint.camera.intrinsics.double().numpy()
    triangles = (red_car.mesh.vertices @ photo.viewpoint.rotation.T + photo.viewpoint.translation)[red_car.mesh.faces]
    for row, column in [*zip(rows[inner], columns[inner], strict=True), *beside]:
        direction = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
        expected = first_hit(np.zeros(3), direction, triangles)
        if np.isnan(photo.depth_m[row, column]):
            assert np.isinf(expected)
        else:
            assert photo.depth_m[row, column] == pytest.approx(expected, abs=2e-4)  # float32 at 20 m


def test_depth_back_projected_lies_on_the_car_in_its_box(photographs: list[Photograph], red_car: Car) -> None:
    for photo in photographs:
        camera, box = photo.viewpoint.camera, photo.viewpoint.box(red_car.mesh)
        rows, columns = np.nonzero(photo.mask)
        positions = torch.tensor(np.stack([columns + 0.5, rows + 0.5], -1), dtype=torch.float32)
        points = camera.unproject(positions, torch.tensor(photo.depth_m[photo.mask]))
        local = (points - box.center) @ box.rotation
        assert bool((local.abs() <= box.size / 2 + 1e-3).all())


def test_interpolated_positions_are_the_points_hit(red_car: Car) -> None:
    """Vertex values at a hit carry the right weights: the vertices' own positions give the point on the ray."""
    rng = np.random.default_rng(2)
    origins = 8 * rng.standard_normal((200, 3)) / 1.7
    origins[np.linalg.norm(origins, axis=1) < 4] += 6.0
    directions = rng.uniform(-0.5, 0.5, (200, 3)) - origins
    tracer = Tracer(red_car.mesh)
    hits = tracer.first_hits(origins, directions)
    assert len(hits.ray) > 100
    points = origins[hits.ray] + hits.distance[:, None] * directions[hits.ray]
    assert np.allclose(tracer.interpolate(red_car.mesh.vertices, hits), points, atol=1e-4)
    towards = points - 1e-3 * directions[hits.ray]
    assert not tracer.is_occluded(towards, -directions[hits.ray]).any()  # first hits: nothing lies before them


def test_views_agree(photographs: list[Photograph], red_car: Car) -> None:
    """A point that two views see lies, by their cameras, at equal depth in both."""
    a, b = sorted(photographs, key=lambda photo: photo.viewpoint.azimuth_rad)[2:4]  # neighbours
    tracer = Tracer(red_car.mesh)
    rows, columns = np.nonzero(a.mask)
    origins, directions = a.viewpoint.rays(np.stack([columns + 0.5, rows + 0.5], -1).astype(float))
    points = origins + a.depth_m[a.mask][:, None] * directions
    centre = -b.viewpoint.rotation.T @ b.viewpoint.translation
    towards = points - centre
    hits = tracer.first_hits(np.broadcast_to(centre, towards.shape), towards)
    is_seen = np.zeros(len(points), bool)
    is_seen[hits.ray] = hits.distance > 0.9999  # the ray's first hit is the point itself
    assert is_seen.sum() > 50
    u, v = np.floor(b.viewpoint.project(points[is_seen])).astype(int).T
    near = binary_dilation(b.mask, np.ones((3, 3)))  # at the outline a pixel's centre may miss the car
    assert near[v, u].mean() > 0.99
    depth = (points[is_seen] @ b.viewpoint.rotation.T + b.viewpoint.translation)[:, 2]
    assert np.nanmedian(np.abs(b.depth_m[v, u] - depth)) < 0.05


@pytest.mark.parametrize("num", [1, 4, 12])
def test_azimuths_fill_all_sectors(num: int) -> None:
    azimuths = draw_azimuths(np.random.default_rng(num), num)
    assert azimuths.shape == (num,)
    assert ((azimuths >= 0) & (azimuths < 2 * np.pi)).all()
    gaps = np.diff(np.sort(np.concatenate([azimuths, [azimuths.min() + 2 * np.pi]])))
    assert gaps.max() <= 2 * 2 * np.pi / num + 1e-9


def _marked(car: Car, at: tuple[float, float, float]) -> CarMesh:
    """The car with a small tetrahedron of its own."""
    mesh = car.mesh
    corners = np.array(at) + 0.15 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    none = np.zeros(4, int)
    return replace(
        mesh, vertices=corners, normals=corners, uv=corners[:, :2], faces=faces, face_material=none, face_chart=none - 1
    )


@pytest.mark.parametrize(
    ("azimuth_deg", "marker", "side"),
    [
        (0, (0, 0, 1.0), "right"),  # face to face with a car, its left is on the viewer's right
        (180, (0, 0, 1.0), "left"),
        (90, (1.0, 0, 0), "left"),  # on its left side, its front points to the viewer's left
        (270, (1.0, 0, 0), "right"),
        (35, (0, -1.0, 0), "top"),
    ],
)
def test_no_view_is_mirrored(red_car: Car, azimuth_deg: float, marker: tuple[float, float, float], side: str) -> None:
    view = viewpoint_at(
        red_car.mesh, azimuth_rad=float(np.radians(azimuth_deg)), elevation_rad=0.1, distance_m=9.0, size_px=64
    )
    mask, _ = exact_truth(Tracer(_marked(red_car, marker)), view)
    rows, columns = np.nonzero(mask)
    assert len(rows) > 0
    middle = view.project(np.zeros((1, 3)))[0]
    u, v = columns.mean() + 0.5 - middle[0], rows.mean() + 0.5 - middle[1]
    assert {"right": u > 3, "left": u < -3, "top": v < -3}[side]


def test_kitti_cameras_are_level_and_phones_look_down(red_car: Car) -> None:
    for index in range(20):
        rng = np.random.default_rng(index)
        level = draw_viewpoint(rng, red_car.mesh, kind="kitti", azimuth_rad=float(index), size_px=64)
        yaw = yaw_from_rotation(torch.tensor(level.rotation))
        assert torch.allclose(rotation_y(yaw), torch.tensor(level.rotation), atol=1e-12)
        position = -level.rotation.T @ level.translation
        assert 1.55 <= red_car.mesh.size[1] / 2 - position[1] <= 1.75
        phone = draw_viewpoint(rng, red_car.mesh, kind="phone", azimuth_rad=float(index), size_px=64)
        pitch = np.degrees(np.arcsin(phone.rotation[2, 1]))  # the camera's z axis in the car frame, y down
        assert 4.9 < pitch < 15.1
        place = -phone.rotation.T @ phone.translation
        assert np.allclose(place[[0, 2]] / np.hypot(*place[[0, 2]]), [np.cos(index), np.sin(index)], atol=1e-9)


def test_look_is_a_rotation_that_faces_forward() -> None:
    rotation = look(np.array([1.0, 0.2, -0.3]), 0.1)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    forward = rotation @ (np.array([1.0, 0.2, -0.3]) / np.linalg.norm([1.0, 0.2, -0.3]))
    assert np.allclose(forward, [0, 0, 1], atol=1e-12)


def test_the_paint_is_seen(photographs: list[Photograph]) -> None:
    """A red car: red well above green and blue over the mask, not beside it."""
    for photo in photographs:
        on, off = (photo.image[where].astype(float).mean(axis=0) for where in (photo.mask, ~photo.mask))
        assert on[0] > 1.35 * on[1]
        assert on[0] > 1.35 * on[2]
        assert off[0] < 1.2 * off[1:].max()


def test_the_ground_is_darker_below_the_car(red_car: Car) -> None:
    """Ambient occlusion: light on the ground under the car against the same far away."""
    scene = draw_scene(red_car, np.random.default_rng(4))
    ground = red_car.mesh.size[1] / 2
    below, beside = (scene.baked.ground_light(np.array([[0.0, ground, z]])).sum() for z in (0.0, 2.6))
    assert below < 0.35 * beside


def test_a_seed_decides_every_pixel(red_car: Car, photographs: list[Photograph]) -> None:
    again = draw_photographs(red_car, seed=(11, 0), num_views=6, size_px=96, cameras="mixed")
    assert all(np.array_equal(a.image, b.image) for a, b in zip(photographs, again, strict=True))
    other = draw_photographs(red_car, seed=(11, 1), num_views=1, size_px=96, cameras="mixed")
    assert not np.array_equal(other[0].image, photographs[0].image)


def test_picture_for_the_documentation(red_car: Car) -> None:
    photo = picture(red_car, size_px=64)
    assert photo.image.shape == (64, 64, 3)
    assert 0.1 < photo.mask.mean() < 0.8
