"""LiDAR points of a frame, or of its neighbours carried over by their poses, in the frame's camera."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from carstudio.errors import InputError
from carstudio.files import inside, read_bounded
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera
from carstudio.geometry.transforms import transform_points
from carstudio.scene.footprint import outline_mask
from carstudio.scene.frame_jobs import Neighbour
from carstudio.scene.graph import PlacedBox, SceneFrame

MAX_SCAN_BYTES = 64 * 1024 * 1024  # four million points: thirty times a scan of KITTI's
_POINT_BYTES = 16  # x, y, z, reflectance, float32
NEAREST_M = 0.5
_GHOST_M = 0.5  # how far a car's points lie from its labelled box


def read_scan(root: str, frame: SceneFrame) -> Float[np.ndarray, "n 3"]:
    """Points of the frame's own scan in its camera, those before it; `InputError` names a broken file."""
    assert frame.lidar is not None, "the caller asks for frames with LiDAR"
    assert frame.camera_from_lidar is not None, "and a calibration"
    path = inside(Path(root), frame.lidar.path)
    data = read_bounded(path, "LiDAR scan", max_bytes=MAX_SCAN_BYTES)
    if len(data) % _POINT_BYTES:
        raise InputError(
            f"{path}: expected points of {_POINT_BYTES} bytes (x, y, z, reflectance as float32), found {len(data)} "
            "bytes, which is no multiple; copy the file again"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    matrix = np.array(frame.camera_from_lidar, np.float64)
    points = points[np.isfinite(points).all(axis=1)] @ matrix[:3, :3].T + matrix[:3, 3]
    return points[points[:, 2] > NEAREST_M]


def background_points(
    root: str, frame: SceneFrame, gone: Sequence[PlacedBox], scans: Sequence[Neighbour]
) -> Float[np.ndarray, "n 3"] | None:
    """Points of what stands still, camera frame: of the frame's own scan, else of its neighbours'; None without any.

    Points in boxes are left out: of the own scan those in `gone` (whatever is still seen in the photograph stays), of
    others all, for a car has moved on when the next frame is taken.
    """
    if frame.lidar is not None and frame.camera_from_lidar is not None:
        return without_ghosts(outside_boxes(read_scan(root, frame), gone), gone, frame.camera())
    if frame.world_from_camera is None:
        return None
    camera_from_world = np.linalg.inv(np.array(frame.world_from_camera, np.float64))
    found = []
    for scan in scans:
        if scan.frame.world_from_camera is None:
            continue
        points = outside_boxes(read_scan(root, scan.frame), scan.boxes)
        move = camera_from_world @ np.array(scan.frame.world_from_camera, np.float64)
        points = points @ move[:3, :3].T + move[:3, 3]
        found.append(points[points[:, 2] > NEAREST_M])
    return np.concatenate(found) if found else None


def outside_boxes(
    points: Float[np.ndarray, "n 3"], boxes: Sequence[PlacedBox], *, grow: float = 1.15
) -> Float[np.ndarray, "m 3"]:
    """The points in none of the boxes, each enlarged by `grow` (mirrors, labels' errors, smear)."""
    kept = points
    for box in boxes:
        kept = kept[~inside_box(kept, box, grow)]
    return kept


def without_ghosts(
    points: Float[np.ndarray, "n 3"], boxes: Sequence[PlacedBox], camera: Camera
) -> Float[np.ndarray, "m 3"]:
    """Without the points that appear in a box's outline about as far away as the box: labels are not that exact."""
    kept = points
    for box in boxes:
        depths = box.box().corners()[0, :, 2]
        nearest, farthest = float(depths.min()) - _GHOST_M, float(depths.max()) + _GHOST_M
        suspect = np.nonzero((kept[:, 2] > max(nearest, NEAREST_M)) & (kept[:, 2] < farthest))[0]
        column, row = _pixels_of(kept[suspect], camera)
        seen = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        outline = outline_mask(box, camera, grow_px=2)
        ghosts = suspect[seen][outline[row[seen], column[seen]]]
        kept = np.delete(kept, ghosts, axis=0)
    return kept


def _pixels_of(points: Float[np.ndarray, "n 3"], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of points before the camera, possibly outside the picture."""
    wide = Camera(camera.intrinsics.double(), camera.width, camera.height)
    places = wide.project(torch.from_numpy(points)).numpy().clip(-1e6, 1e6)
    column, row = np.floor(places).astype(np.int64).T
    return column, row


def inside_box(points: Float[np.ndarray, "n 3"], placed: PlacedBox, grow: float = 1.0) -> Bool[np.ndarray, " n"]:
    """Which points lie in a box `grow` times as large."""
    transform = canonical_from_camera(placed.box())[0].double()
    places = transform_points(transform, torch.from_numpy(points)).abs()
    result: Bool[np.ndarray, " n"] = (places <= grow).all(dim=-1).numpy()
    return result


def sparse_depth(points: Float[np.ndarray, "n 3"], camera: Camera) -> Float[np.ndarray, "height width"]:
    """Depth (m) of the nearest point in each pixel, inf where there is none."""
    depth = np.full(camera.height * camera.width, np.inf)
    column, row = _pixels_of(points, camera)
    seen = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    np.minimum.at(depth, row[seen] * camera.width + column[seen], points[seen, 2])
    return depth.reshape(camera.height, camera.width)
