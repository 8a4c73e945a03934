"""What has to be known to draw one frame, as a small value that is sent to another process: no scene, no pixels."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from carstudio.errors import InputError
from carstudio.scene.graph import CarRef, PlacedBox, Scene, SceneFrame, Vector3

LIDAR_FRAMES_AWAY = 10  # farther scans see other streets, and poses drift
FILL_FRAMES_AWAY, FILL_FRAMES = 30, 16  # where a deleted car's background is looked for, and in how many frames

DepthOf = Literal["auto", "ground"]


@dataclass(frozen=True, kw_only=True)
class DrawingSettings:
    """How frames are drawn."""

    rays_per_side: int = 1
    """Rays per pixel and side: 2 are 4 rays per pixel."""
    depth: DepthOf = "auto"
    """auto: LiDAR where the log has it, then the network if one is named, then the ground; ground: ground and boxes."""
    depth_network: str | None = None
    """Hub name or folder of a monocular depth network."""
    has_shadows: bool = True
    """Contact shadows under drawn cars."""
    is_matched: bool = True
    """Exposure, white balance, blur and noise of drawn cars as the photographs have them."""
    fills_from_frames: bool = True
    """Look into other frames for what deleted cars hid, before inpainting."""
    model: str | None = None
    """Folder of the run that cars were made with, where they were not made with a bundled model."""


PRESETS = {
    "fast": DrawingSettings(),
    "fine": DrawingSettings(rays_per_side=2),
}


def drawing_settings(preset: str, *, depth: str = "auto", model: Path | None = None) -> DrawingSettings:
    """A preset with the depth that is asked for: auto, ground, or transformers:NAME_OR_FOLDER (a monocular network)."""
    settings = replace(PRESETS[preset], model=None if model is None else str(model))
    kind, _, name = depth.partition(":")
    if depth == "auto":
        return settings
    if depth == "ground":
        return replace(settings, depth="ground")
    if kind != "transformers" or not name:
        raise InputError(f"--depth must be auto, ground or transformers:NAME_OR_FOLDER, found {depth!r}")
    return replace(settings, depth_network=name)


@dataclass(frozen=True, kw_only=True)
class PlacedObject:
    """A track in one frame. `number` is its value in instance images, the same in all frames; `gain` is linear RGB."""

    track_id: str
    number: int
    type: str
    box: PlacedBox
    car: CarRef | None
    is_drawn: bool
    gain: Vector3 = (1.0, 1.0, 1.0)
    label: dict[str, Any] | None = None  # the source's own, of an object that nobody has touched


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """Another frame of the log, and all that stood in it."""

    frame: SceneFrame
    boxes: tuple[PlacedBox, ...]


@dataclass(frozen=True)
class Sensor:
    """The photographs' sharpness (standard deviation of the blur, px) and noise (of 8-bit values, in [0, 1])."""

    blur_px: float = 0.0
    noise: float = 0.0


@dataclass(frozen=True, kw_only=True)
class FrameJob:
    """One frame to draw. `gone` are boxes of the photograph whose cars are drawn anew, or not at all."""

    root: str
    scene_folder: str
    frame: SceneFrame
    objects: tuple[PlacedObject, ...]
    gone: tuple[PlacedBox, ...] = ()
    scans: tuple[Neighbour, ...] = ()
    neighbours: tuple[Neighbour, ...] = ()
    sensor: Sensor = Sensor()
    settings: DrawingSettings = DrawingSettings()


def instance_numbers(*scenes: Scene) -> dict[str, int]:
    """Track id -> number from 1 on, in the natural order of the ids; the same whatever the order of the tracks."""
    ids = {track_id for scene in scenes for track_id in scene.tracks}

    def natural(track_id: str) -> list[tuple[int, int, str]]:
        parts = re.split(r"(\d+)", track_id)
        return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]

    return {track_id: i for i, track_id in enumerate(sorted(ids, key=natural), start=1)}


def frame_job(
    original: Scene,
    edited: Scene,
    index: int,
    scene_folder: str,
    *,
    settings: DrawingSettings | None = None,
    sensor: Sensor | None = None,
    gains: Mapping[str, Vector3] | None = None,
) -> FrameJob:
    """The job of the frame of that index; `InputError` for a track that was moved but has no car to draw."""
    numbers = instance_numbers(original, edited)
    settings = settings or DrawingSettings()
    frame = edited.frame(index)
    objects = []
    for track_id, track in sorted(edited.tracks.items(), key=lambda item: numbers[item[0]]):
        if index not in track.boxes:
            continue
        is_drawn = track.is_drawn_at(index)
        if is_drawn and track.car is None:
            raise InputError(f"track {track_id}, frame {index}: has no car, so it cannot be drawn; replace it by one")
        before = original.tracks.get(track_id)
        if not is_drawn and (before is None or before.boxes.get(index) != track.boxes[index]):
            raise InputError(
                f"track {track_id}, frame {index}: moved or new, but left to the photograph; let it be drawn (is_drawn)"
            )
        label = track.labels.get(index)
        objects.append(
            PlacedObject(
                track_id=track_id,
                number=numbers[track_id],
                type=track.type,
                box=track.boxes[index],
                car=track.car,
                is_drawn=is_drawn,
                gain=(gains or {}).get(track_id, (1.0, 1.0, 1.0)) if is_drawn else (1.0, 1.0, 1.0),
                label=dict(label) if label is not None and not is_drawn else None,
            )
        )
    gone = tuple(
        track.boxes[index]
        for track_id, track in sorted(original.tracks.items(), key=lambda item: numbers[item[0]])
        if index in track.boxes and not track.is_drawn_at(index) and not _is_left(edited, track_id, index)
    )
    return FrameJob(
        root=edited.root,
        scene_folder=scene_folder,
        frame=frame,
        objects=tuple(objects),
        gone=gone,
        scans=_scans(original, frame) if settings.depth == "auto" else (),
        neighbours=_fill_frames(original, frame) if gone and settings.fills_from_frames else (),
        sensor=sensor or Sensor(),
        settings=settings,
    )


def _is_left(edited: Scene, track_id: str, index: int) -> bool:
    """Whether the photograph still shows the track."""
    track = edited.tracks.get(track_id)
    return track is not None and index in track.boxes and not track.is_drawn_at(index)


def neighbour(scene: Scene, frame: SceneFrame) -> Neighbour:
    """A frame with all boxes that stand in its photograph."""
    boxes = [track.boxes[frame.index] for track in scene.tracks.values() if frame.index in track.boxes]
    return Neighbour(frame=frame, boxes=tuple(boxes))


def _scans(scene: Scene, frame: SceneFrame) -> tuple[Neighbour, ...]:
    """The frame with LiDAR before and the one after, where the frame itself has none."""
    if frame.lidar is not None or frame.world_from_camera is None:
        return ()
    near = [
        other
        for other in scene.frames
        if other.lidar is not None
        and other.world_from_camera is not None
        and 0 < abs(other.index - frame.index) <= LIDAR_FRAMES_AWAY
    ]
    before = [other for other in near if other.index < frame.index][-1:]
    after = [other for other in near if other.index > frame.index][:1]
    return tuple(neighbour(scene, other) for other in before + after)


def _fill_frames(scene: Scene, frame: SceneFrame) -> tuple[Neighbour, ...]:
    """Frames with poses around this one, evenly spread."""
    if frame.world_from_camera is None:
        return ()
    near = [
        other
        for other in scene.frames
        if other.world_from_camera is not None and 0 < abs(other.index - frame.index) <= FILL_FRAMES_AWAY
    ]
    step = max(1, -(-len(near) // FILL_FRAMES))
    return tuple(neighbour(scene, other) for other in near[::step])
