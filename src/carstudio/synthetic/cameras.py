"""Where photographs are taken from: like KITTI's car roof, or like a person with a phone.

A viewpoint is a camera with its pose; the photo is a square window of the camera's picture that the car fills to
70-95 %, so the principal point need not lie in the window. Car frame: x front, y down, z left, ground at y = ground_y.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.synthetic.surfaces import CarMesh

CameraKind = Literal["kitti", "phone", "mixed"]

KITTI_FOCAL_PX, KITTI_CX, KITTI_CY = 721.5377, 609.5593, 172.854  # P2 of the raw recordings of 2011-09-26
PHONE_WIDTH_PX, PHONE_HEIGHT_PX = 4032.0, 3024.0  # 12-megapixel phones


@dataclass(frozen=True)
class Viewpoint:
    """A camera of size x size px and the pose `camera_from_car` (rotation, translation in m). Azimuth and elevation of
    the camera seen from the car, rad: azimuth 0 is before the car's front, pi/2 on its left side.
    """

    camera: Camera
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    azimuth_rad: float
    elevation_rad: float
    kind: str

    def box(self, mesh: CarMesh) -> Box3D:
        """The car's exact bounding box in this camera, float32."""
        center, size, rotation = (
            torch.tensor(np.asarray(value), dtype=torch.float32)
            for value in (self.translation, mesh.size, self.rotation)
        )
        return Box3D(center, size, rotation)

    def project(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Image positions of points of the car frame, px, float64."""
        fx, fy, cx, cy = self.camera.intrinsics.double().tolist()
        x, y, z = (points @ self.rotation.T + self.translation).T
        return np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)

    def rays(self, positions: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Origins and directions (camera z = 1) in the car frame of rays through image positions (px)."""
        fx, fy, cx, cy = self.camera.intrinsics.double().tolist()
        local = np.stack([(positions[:, 0] - cx) / fx, (positions[:, 1] - cy) / fy, np.ones(len(positions))], axis=-1)
        origin = -self.rotation.T @ self.translation
        return np.broadcast_to(origin, local.shape), local @ self.rotation


def look(forward: Float[np.ndarray, "3"], roll_rad: float = 0.0) -> Float[np.ndarray, "3 3"]:
    """Rotation camera_from_car of a camera that looks along `forward` (car frame), upright but for the roll."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(np.array([0.0, 1.0, 0.0]), z)
    x /= np.linalg.norm(x)
    upright = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) @ upright


def draw_viewpoint(
    rng: np.random.Generator, mesh: CarMesh, *, kind: CameraKind, azimuth_rad: float, size_px: int
) -> Viewpoint:
    """A viewpoint at an azimuth; height, distance, pose and window are drawn."""
    if kind == "mixed":
        kind = "kitti" if rng.random() < 0.5 else "phone"
    bearing = np.array([np.cos(azimuth_rad), 0.0, np.sin(azimuth_rad)])
    ground = float(mesh.size[1]) / 2
    if kind == "kitti":
        distance = np.exp(rng.uniform(np.log(6.0), np.log(22.0)))
        position = distance * bearing + np.array([0, ground - rng.uniform(1.55, 1.75), 0])
        rotation = look(_turn(-bearing, np.radians(rng.uniform(-28, 28))))  # KITTI sees 40 degrees to each side
        intrinsics = np.array([KITTI_FOCAL_PX, KITTI_FOCAL_PX, KITTI_CX, KITTI_CY])
    else:
        distance = rng.uniform(float(mesh.size[0]) / 2 + 2.2, float(mesh.size[0]) / 2 + 5.5)
        pitch = np.radians(rng.uniform(5, 15))
        height = np.clip(ground + distance * np.tan(pitch) * rng.uniform(0.8, 1.1), 1.2, 2.6)
        position = distance * bearing + np.array([0, ground - height, 0])
        forward = _turn(-bearing, np.radians(rng.uniform(-7, 7))) * np.cos(pitch) + np.array([0, np.sin(pitch), 0])
        rotation = look(forward, np.radians(np.clip(rng.normal(0, 2), -5, 5)))
        focal = PHONE_WIDTH_PX / 2 / np.tan(np.radians(rng.uniform(60, 74) / 2))  # main cameras of phones
        intrinsics = np.array([focal, focal, PHONE_WIDTH_PX / 2, PHONE_HEIGHT_PX / 2])
    elevation = float(np.arctan2(-position[1], distance))
    camera = fit_window(rng, mesh, intrinsics, rotation, -rotation @ position, size_px)
    return Viewpoint(camera, rotation, -rotation @ position, azimuth_rad, elevation, kind)


def _turn(vector: Float[np.ndarray, "3"], angle_rad: float) -> Float[np.ndarray, "3"]:
    """Rotated about the vertical."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y, z = vector
    return np.array([c * x + s * z, y, c * z - s * x])


def fit_window(
    rng: np.random.Generator,
    mesh: CarMesh,
    intrinsics: Float[np.ndarray, "4"],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    size_px: int,
) -> Camera:
    """The camera of a square window that the car fills to 70-95 % (by its greater extent), resized to `size_px`."""
    x, y, z = (mesh.vertices @ rotation.T + translation).T
    assert z.min() > 0.1, z.min()
    fx, fy, cx, cy = intrinsics
    u, v = fx * x / z + cx, fy * y / z + cy
    extent = np.array([u.max() - u.min(), v.max() - v.min()])
    side = extent.max() / rng.uniform(0.70, 0.95)
    slack = (side - extent) / 2
    low = np.array([u.min(), v.min()]) - slack * (1 + rng.uniform(-0.6, 0.6, 2))
    scale = size_px / side
    window = torch.tensor([fx * scale, fy * scale, (cx - low[0]) * scale, (cy - low[1]) * scale], dtype=torch.float32)
    return Camera(window, size_px, size_px)


def viewpoint_at(
    mesh: CarMesh, *, azimuth_rad: float, elevation_rad: float, distance_m: float, size_px: int
) -> Viewpoint:
    """A viewpoint chosen by hand: the camera looks at the car's centre, the car fills 90 % of the picture."""
    bearing = np.array([np.cos(azimuth_rad), 0.0, np.sin(azimuth_rad)])
    position = distance_m * (np.cos(elevation_rad) * bearing + np.array([0, -np.sin(elevation_rad), 0]))
    rotation = look(-position)
    x, y, z = (mesh.vertices @ rotation.T - rotation @ position).T
    u, v = x / z, y / z
    focal = 0.9 * size_px / max(u.max() - u.min(), v.max() - v.min())
    cx, cy = (size_px / 2 - focal * (w.max() + w.min()) / 2 for w in (u, v))
    camera = Camera(torch.tensor([focal, focal, cx, cy], dtype=torch.float32), size_px, size_px)
    return Viewpoint(camera, rotation, -rotation @ position, azimuth_rad, elevation_rad, "chosen")
