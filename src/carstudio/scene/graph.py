"""The scene as a value: frames, and cars with a box per frame. Nothing here is ever changed in place.

A scene knows where photographs and cars lie and what their bytes were (sha256); it does not hold pixels or tensors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_from_quaternion

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class FileRef:
    """A file below the scene's log (`Scene.root`) or below the scene's own folder, and the sha256 of its bytes."""

    path: str  # relative, forward slashes
    sha256: str


@dataclass(frozen=True)
class PlacedBox:
    """A car's box in one frame: centre (OpenCV camera, m), size (length, height, width, m), quaternion (w, x, y, z)."""

    center: Vector3
    size: Vector3
    rotation: Quaternion

    def box(self) -> Box3D:
        """As tensors, a batch of one."""
        rotation = rotation_from_quaternion(torch.tensor([self.rotation], dtype=torch.float64)).float()
        return Box3D(torch.tensor([self.center]), torch.tensor([self.size]), rotation)


@dataclass(frozen=True, kw_only=True)
class SceneFrame:
    """One photograph of the log. Intrinsics in px, pixel centres at +0.5; poses are 4 x 4, metres."""

    index: int
    name: str  # stem of the outputs, "000012"
    image: FileRef
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy
    camera_offset: Vector3 = (0.0, 0.0, 0.0)  # X_camera = X_label_frame + camera_offset
    world_from_camera: Matrix | None = None  # None: the log has no poses
    lidar: FileRef | None = None  # KITTI velodyne points
    camera_from_lidar: Matrix | None = None
    depth: FileRef | None = None  # 16-bit PNG, depth in m times 256 (KITTI's format), where the log has one

    def camera(self) -> Camera:
        """The whole photograph's camera."""
        return Camera(torch.tensor(self.intrinsics), self.width, self.height)


@dataclass(frozen=True)
class CarRef:
    """A CAR folder below the scene's `cars/`, by name, and the sha256 of its car.json."""

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class Track:
    """One object through the log. `car` is what it looks like when it is drawn; None: never lifted.

    `is_drawn` False leaves the object to the photograph (nobody has touched it); True draws it, in all its frames or
    in those of `drawn_in` (an edit of frames 5-10 leaves frame 4 to the photograph). `labels` keeps the source's own
    record per frame.
    """

    track_id: str
    type: str = "Car"
    boxes: Mapping[int, PlacedBox] = field(default_factory=dict)  # by frame index
    car: CarRef | None = None
    is_drawn: bool = False
    drawn_in: frozenset[int] | None = None  # None: all frames it has a box in
    labels: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "boxes", MappingProxyType(dict(self.boxes)))
        object.__setattr__(self, "labels", MappingProxyType(dict(self.labels)))

    def is_drawn_at(self, frame: int) -> bool:
        """Whether the track is drawn in the frame of that index, rather than left to the photograph or not there."""
        return self.is_drawn and frame in self.boxes and (self.drawn_in is None or frame in self.drawn_in)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A log: its folder, frames in order of their index, tracks by id."""

    root: str  # folder of the log that FileRefs of photographs and LiDAR lie below
    source: str  # "kitti-mot", ...
    licence: str
    frames: tuple[SceneFrame, ...]
    tracks: Mapping[str, Track] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tracks", MappingProxyType(dict(self.tracks)))

    def frame(self, index: int) -> SceneFrame:
        """The frame of that index; `KeyError` when there is none."""
        for frame in self.frames:
            if frame.index == index:
                return frame
        raise KeyError(index)

    def with_track(self, track: Track) -> "Scene":
        """The scene with this track put in or replaced."""
        return replace(self, tracks={**self.tracks, track.track_id: track})

    def without_track(self, track_id: str) -> "Scene":
        """The scene without a track."""
        return replace(self, tracks={name: track for name, track in self.tracks.items() if name != track_id})
