"""The edited log in forms that other programs open: a KITTI tracking folder, and nerfstudio's `transforms.json`."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carstudio.files import make_folder, write_bytes, write_json, write_text
from carstudio.scene.frame_jobs import instance_numbers
from carstudio.scene.graph import Scene, SceneFrame

KITTI, TRANSFORMS = "kitti", "transforms.json"
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def tracking_ids(original: Scene, edited: Scene) -> dict[str, int]:
    """Track id -> KITTI's whole number: its own where the id is one, else free ones above them."""
    ids = list(instance_numbers(original, edited))
    numbers = {track_id: int(track_id) for track_id in ids if track_id.isdigit() and len(track_id) < 9}
    free = max(numbers.values(), default=-1) + 1
    for track_id in ids:
        if track_id not in numbers:
            numbers[track_id] = free
            free += 1
    return numbers


def write_kitti(
    out: Path, sequence: str, frames: Sequence[SceneFrame], labels: Mapping[int, Sequence[tuple[int, str]]]
) -> None:
    """Below `out`: image_02/SEQ, label_02/SEQ.txt, calib/SEQ.txt and, with poses, poses/SEQ.txt.

    `labels`: frame index -> (track number, 15 columns). Pictures are hard links to `out`/../rgb where the file system
    has them. Poses have a line per frame number from 0 on, as KITTI odometry's; frames that the log does not have, or
    without a pose, are nan.
    """
    for frame in frames:
        _link(out.parent / "rgb" / f"{frame.name}.png", out / "image_02" / sequence / f"{frame.index:06d}.png")
    lines = [f"{index} {number} {line}" for index, found in sorted(labels.items()) for number, line in found]
    write_text(out / "label_02" / f"{sequence}.txt", "".join(f"{line}\n" for line in lines))
    if frames:
        write_text(out / "calib" / f"{sequence}.txt", calibration_text(frames[0]))
    poses = {frame.index: frame.world_from_camera for frame in frames if frame.world_from_camera is not None}
    if poses:
        missing = " ".join(["nan"] * 12)
        rows = [
            " ".join(f"{value:.9e}" for row in poses[i][:3] for value in row) if i in poses else missing
            for i in range(max(poses) + 1)
        ]
        write_text(out / "poses" / f"{sequence}.txt", "".join(f"{row}\n" for row in rows))


def _link(source: Path, target: Path) -> None:
    if target.exists() and os.path.samefile(source, target):
        return
    make_folder(target.parent)
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without links
        write_bytes(target, source.read_bytes())


def calibration_text(frame: SceneFrame) -> str:
    """P0 to P3 and the transforms of a tracking calibration, from which our own reader finds the frame's camera again.

    Only camera 2 is known: the others repeat it. A log without LiDAR gets the turn of the axes alone.
    """
    fx, fy, cx, cy = frame.intrinsics
    x, y, z = frame.camera_offset
    matrix = np.array([[fx, 0, cx, fx * x + cx * z], [0, fy, cy, fy * y + cy * z], [0, 0, 1, z]])
    projection = " ".join(f"{value:.12e}" for value in matrix.flatten())
    lines = [f"P{camera}: {projection}" for camera in range(4)]
    lines += ["R_rect 1 0 0 0 1 0 0 0 1", f"Tr_velo_cam {_label_frame_from_lidar(frame)}"]
    return "\n".join([*lines, "Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n"


def _label_frame_from_lidar(frame: SceneFrame) -> str:
    if frame.camera_from_lidar is None:
        return "0 -1 0 0 0 0 -1 0 1 0 0 0"
    matrix = np.array(frame.camera_from_lidar, np.float64)[:3].copy()
    matrix[:, 3] -= np.array(frame.camera_offset)
    return " ".join(f"{value:.12e}" for value in matrix.flatten())


def transforms_json(frames: Sequence[SceneFrame]) -> dict[str, Any] | None:
    """Nerfstudio's description of the frames with poses: OpenGL cameras in the log's world; None without any pose.

    Depth images are in 1/256 m: nerfstudio's `--depth-unit-scale-factor 0.00390625`.
    """
    posed = [frame for frame in frames if frame.world_from_camera is not None]
    if not posed:
        return None
    entries = []
    for frame in posed:
        world_from_opengl = np.array(frame.world_from_camera, np.float64) @ _OPENCV_FROM_OPENGL
        fx, fy, cx, cy = frame.intrinsics
        entries.append(
            {
                "file_path": f"rgb/{frame.name}.png",
                "depth_file_path": f"depth/{frame.name}.png",
                "transform_matrix": world_from_opengl.tolist(),
                **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": frame.width, "h": frame.height},
            }
        )
    return {"camera_model": "PINHOLE", "depth_unit_scale_factor": 1 / 256, "frames": entries}


def write_transforms(out: Path, frames: Sequence[SceneFrame]) -> bool:
    """Write `transforms.json` beside rgb/ and depth/; False where the log has no poses."""
    value = transforms_json(frames)
    if value is not None:
        write_json(out / TRANSFORMS, value)
    return value is not None
