"""A camera that circles a car: what it faces, that the car stands upright and fits into the picture."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from carstudio.geometry.box3d import Box3D, envelope
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance, viewing_angles
from carstudio.geometry.transforms import rotation_y

SIZE = torch.tensor([4.2, 1.5, 1.8], dtype=torch.float64)
AZIMUTHS, ELEVATIONS = st.floats(-360, 360), st.floats(-90, 90)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "facing"),
    [(0, 0, (1, 0, 0)), (90, 0, (0, 0, 1)), (180, 0, (-1, 0, 0)), (270, 0, (0, 0, -1)), (30, 90, (0, -1, 0))],
)
def test_the_camera_faces_front_left_rear_right_and_roof(azimuth, elevation, facing):
    box = orbit_box(SIZE, azimuth_deg=float(azimuth), elevation_deg=float(elevation), distance_m=8.0)
    camera_in_car = -(box.rotation.mT @ box.center) / 8.0
    np.testing.assert_allclose(camera_in_car.numpy(), facing, atol=1e-12)


@given(AZIMUTHS, ELEVATIONS)
def test_the_pose_is_a_rotation_made_of_scipys_turns(azimuth, elevation):
    box = orbit_box(SIZE, azimuth_deg=azimuth, elevation_deg=elevation, distance_m=8.0)
    # The rear view is the car turned by -90 degrees about y (it drives away); the orbit turns on from there, and
    # raising the camera tips the car's front about the camera's x axis.
    expected = Rotation.from_euler("x", elevation, degrees=True) * Rotation.from_euler("y", azimuth + 90, degrees=True)
    np.testing.assert_allclose(box.rotation.numpy(), expected.as_matrix(), atol=1e-12)


@given(AZIMUTHS, st.floats(-85, 85))
def test_the_roof_points_up_in_the_picture(azimuth, elevation):
    box = orbit_box(SIZE, azimuth_deg=azimuth, elevation_deg=elevation, distance_m=8.0)
    up = box.rotation @ torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    assert up[1] < 0
    assert abs(up[0]) < 1e-12


@given(AZIMUTHS, ELEVATIONS, st.floats(10, 90))
def test_the_whole_car_is_in_the_picture(azimuth, elevation, field_of_view):
    distance = orbit_distance(SIZE, field_of_view_deg=field_of_view)
    box = orbit_box(SIZE, azimuth_deg=azimuth, elevation_deg=elevation, distance_m=distance)
    camera = orbit_camera(128, field_of_view_deg=field_of_view)
    outline = envelope(box, type(camera)(camera.intrinsics.double(), 128, 128), clip=False)
    assert outline is not None
    assert outline.min() >= 0
    assert outline.max() <= 128


def test_the_bounding_sphere_fills_the_share_that_was_asked_for():
    distance = orbit_distance(SIZE, field_of_view_deg=40.0, fill=0.5)
    radius = math.sqrt(4.2**2 + 1.5**2 + 1.8**2) / 2
    assert math.degrees(math.asin(radius / distance)) == pytest.approx(
        math.degrees(math.asin(0.5 * math.sin(math.radians(20)))), rel=1e-9
    )


def test_the_focal_length_spans_the_field_of_view():
    camera = orbit_camera(100, field_of_view_deg=90.0)
    assert camera.intrinsics.tolist() == pytest.approx([50, 50, 50, 50])


@given(AZIMUTHS, st.floats(-89, 89))
def test_viewing_angles_turn_the_orbit_round(azimuth, elevation):
    box = orbit_box(SIZE, azimuth_deg=azimuth, elevation_deg=elevation, distance_m=8.0)
    seen_azimuth, seen_elevation = viewing_angles(box)
    assert math.remainder(float(seen_azimuth) - math.radians(azimuth), 2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert float(seen_elevation) == pytest.approx(math.radians(elevation), abs=1e-9)


def test_viewing_angles_of_a_batch_by_hand():
    """A car that drives away, left of us, 1 m lower than the camera: seen from the rear right."""
    rotation = rotation_y(torch.tensor([-math.pi / 2, math.pi / 2], dtype=torch.float64))
    center = torch.tensor([[-10.0, 1.0, 10.0]], dtype=torch.float64).expand(2, 3)
    azimuth, elevation = viewing_angles(Box3D(center, SIZE.expand(2, 3), rotation))
    np.testing.assert_allclose(np.degrees(azimuth.numpy()), [-135.0, 45.0], atol=1e-9)
    np.testing.assert_allclose(elevation.numpy(), np.arctan2(1.0, np.hypot(10, 10)), atol=1e-12)
