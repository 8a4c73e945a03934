"""A scene from KITTI's folders: tracking (one sequence, tracks with ids) or detection (photographs by themselves).

What cannot be read costs as little as possible and is told in `problems`: a broken photograph or label its frame, a
broken pose file the poses.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from carstudio.dataset.sources.frame import Frame, FrameRef, LabelledObject, Source
from carstudio.dataset.sources.kitti_det import open_kitti_det
from carstudio.dataset.sources.kitti_format import read_text
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.errors import InputError
from carstudio.files import sha256_file
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_y
from carstudio.images import image_size
from carstudio.progress import Report, silent
from carstudio.scene.graph import FileRef, Matrix, PlacedBox, Scene, SceneFrame, Track
from carstudio.scene.poses import lidar_and_imu, read_odometry_poses, read_oxts_poses, to_matrix

IdOf = Callable[[Frame, LabelledObject], str]


@dataclass(frozen=True)
class Log:
    """A scene without cars, the source its photographs come from, and where each frame is found in it."""

    scene: Scene
    source: Source
    refs: Mapping[int, FrameRef]  # by frame index
    problems: tuple[str, ...]

    def track_of(self, frame: Frame, thing: LabelledObject) -> str:
        """The id of the track that an object of a loaded frame belongs to."""
        return _mot_id(frame, thing) if "track" in thing.extra else _det_id(frame, thing)


def open_mot_log(root: Path, sequence: str, *, frames: str | None = None, report: Report = silent) -> Log:
    """One sequence of KITTI tracking; `InputError` when it is not there or no frame of it can be read."""
    source = open_kitti_mot(root, sequence=sequence, frames=frames)
    drive = source.drives[sequence]
    calib = source.folder / "calib" / f"{sequence}.txt"
    known = lidar_and_imu(read_text(calib, "calibration"), drive.calibration.camera_offset, name=f"calib/{calib.name}")
    problems: list[str] = []
    poses: dict[int, Matrix] = {}
    pose_file, oxts_file = source.folder / "poses" / f"{sequence}.txt", source.folder / "oxts" / f"{sequence}.txt"
    try:
        if pose_file.is_file():
            poses = read_odometry_poses(pose_file, drive.calibration.camera_offset)
        elif oxts_file.is_file() and "camera_from_imu" in known:
            poses = read_oxts_poses(oxts_file, known["camera_from_imu"])
    except InputError as error:
        problems.append(f"no poses: {error}")
    numbers = {ref.index for ref in source.refs}
    if poses and numbers - set(poses):
        problems.append(f"{len(numbers - set(poses))} frames have no pose; what needs one is refused there")
    last = max(numbers)
    without = sorted(number for number in drive.lines if number not in numbers and min(numbers) <= number <= last)
    if without:
        problems.append(f"labels without a photograph: frames {', '.join(map(str, without[:10]))}; left out")
    lidar = to_matrix(known["camera_from_lidar"]) if "camera_from_lidar" in known else None

    def scene_frame(frame: Frame, ref: FrameRef) -> SceneFrame:
        velodyne = source.folder / "velodyne" / sequence / f"{ref.stem}.bin"
        return _scene_frame(frame, ref, source.folder, velodyne, lidar, poses.get(ref.index))

    return _read(source, source.folder, scene_frame, _mot_id, problems, report)


def open_det_log(root: Path, *, frames: str | None = None, report: Report = silent) -> Log:
    """Photographs of KITTI detection: no poses, and each car is seen once."""
    source = open_kitti_det(root, frames=frames)

    def scene_frame(frame: Frame, ref: FrameRef) -> SceneFrame:
        calib = source.folder / "calib" / f"{ref.stem}.txt"
        known = lidar_and_imu(read_text(calib, "calibration"), frame.camera_offset, name=f"calib/{calib.name}")
        lidar = to_matrix(known["camera_from_lidar"]) if "camera_from_lidar" in known else None
        return _scene_frame(frame, ref, source.folder, source.folder / "velodyne" / f"{ref.stem}.bin", lidar, None)

    return _read(source, source.folder, scene_frame, _det_id, [], report)


def _read(
    source: Source,
    folder: Path,
    scene_frame: Callable[[Frame, FrameRef], SceneFrame],
    id_of: IdOf,
    problems: list[str],
    report: Report,
) -> Log:
    """Load each frame once: its record, its boxes."""
    problems = [*source.problems, *problems]
    frames: dict[int, SceneFrame] = {}
    tracks: dict[str, Track] = {}
    refs = source.frames()
    for done, ref in enumerate(refs, start=1):
        try:
            if ref.index in frames:
                raise InputError(f"frame {ref.index} is there twice ({frames[ref.index].name}); the first is kept")
            frame = source.load(ref)
            frames[ref.index] = scene_frame(frame, ref)
        except InputError as error:
            problems.append(f"frame {ref.stem} left out: {error}")
            continue
        for thing in frame.objects:
            _add(tracks, id_of(frame, thing), thing, ref.index)
        report("reading frames", done, len(refs), ref.stem)
    if not frames:
        raise InputError(f"{folder}: no frame can be read\n" + "\n".join(problems))
    ordered = tuple(frames[index] for index in sorted(frames))
    scene = Scene(root=str(folder.resolve()), source=source.name, licence=source.licence, frames=ordered, tracks=tracks)
    return Log(scene, source, {ref.index: ref for ref in refs if ref.index in frames}, tuple(problems))


def _add(tracks: dict[str, Track], track_id: str, thing: LabelledObject, index: int) -> None:
    box, track = placed_box(thing), tracks.get(track_id, Track(track_id=track_id, type=thing.type))
    if box is None or index in track.boxes:  # no 3-D box; or one frame, one track, twice: the first is kept
        return
    label = {**thing.extra, "box2d": list(thing.box2d), "truncation": thing.truncation, "occlusion": thing.occlusion}
    boxes, labels = {**track.boxes, index: box}, {**track.labels, index: label}
    tracks[track_id] = Track(track_id=track_id, type=track.type, boxes=boxes, labels=labels)


def placed_box(thing: LabelledObject) -> PlacedBox | None:
    """A labelled object's box as the scene keeps it; None when it has none."""
    if thing.box_center is None or thing.box_size is None or thing.box_yaw is None:
        return None
    rotation = thing.box_rotation
    if rotation is None:
        turn = rotation_y(torch.tensor(thing.box_yaw, dtype=torch.float64))
        w, x, y, z = quaternion_from_rotation(turn).tolist()
        rotation = (w, x, y, z)
    return PlacedBox(thing.box_center, thing.box_size, rotation)


def _scene_frame(
    frame: Frame, ref: FrameRef, folder: Path, velodyne: Path, lidar: Matrix | None, pose: Matrix | None
) -> SceneFrame:
    width, height = image_size(frame.image, name=frame.image_path)
    has_lidar = lidar is not None and velodyne.is_file()
    return SceneFrame(
        index=ref.index,
        name=ref.stem,
        image=FileRef(frame.image_path, hashlib.sha256(frame.image).hexdigest()),
        width=width,
        height=height,
        intrinsics=frame.intrinsics,
        camera_offset=frame.camera_offset,
        world_from_camera=pose,
        lidar=FileRef(velodyne.relative_to(folder).as_posix(), sha256_file(velodyne)) if has_lidar else None,
        camera_from_lidar=lidar if has_lidar else None,
    )


def _mot_id(frame: Frame, thing: LabelledObject) -> str:
    return str(thing.extra["track"])


def _det_id(frame: Frame, thing: LabelledObject) -> str:
    return f"{frame.frame_id}-{thing.extra['line']}"
