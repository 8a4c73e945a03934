"""What perception returns, and the protocols of those who return it.

Perception knows nothing of stores: a mask comes as two boolean images, car and unknown, which the dataset encodes.
Positions are px of the whole photograph, pixel (u, v) centred at (u + 0.5, v + 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8


@dataclass(frozen=True)
class Window:
    """A rectangle of whole pixels: the crop that a mask belongs to."""

    x0: int
    y0: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the window in the photograph."""
        return slice(self.y0, self.y0 + self.height), slice(self.x0, self.x0 + self.width)

    def within(self, outer: "Window") -> "Window":
        """The same pixels, counted from the corner of `outer`."""
        return Window(self.x0 - outer.x0, self.y0 - outer.y0, self.width, self.height)


Box2D = tuple[float, float, float, float]  # x0, y0, x1, y1 px of the photograph
Vector3 = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Photo:
    """A photograph as detectors and estimators of 3-D boxes see it, upright, with its camera."""

    image: UInt8[np.ndarray, "height width 3"]
    frame_id: str
    path: str  # relative to the source's root, with forward slashes
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy px, pixel centres at +0.5
    camera_offset: Vector3 = (0.0, 0.0, 0.0)  # m; X_camera = X_label_frame + camera_offset


@dataclass(frozen=True)
class Detection2D:
    """A 2-D box (x0, y0, x1, y1 px) with its class ("Car", "Van", "Truck", "Bus") and confidence in [0, 1]."""

    box2d: Box2D
    type: str
    score: float


@dataclass(frozen=True, kw_only=True)
class Detection3D:
    """A 3-D box in the camera frame, and the 2-D box (px) by which it is joined to detections."""

    box2d: Box2D
    type: str
    center: Vector3  # m, OpenCV camera
    size: Vector3  # length, height, width, m
    yaw: float  # rad, KITTI rotation_y
    rotation: tuple[float, float, float, float] | None = None  # quaternion w, x, y, z where the box is not upright
    score: float | None = None  # in [0, 1]; None: labelled by people


@dataclass(frozen=True, kw_only=True)
class SegmentRequest:
    """One car to be segmented. Hulls are convex outlines of projected 3-D boxes, in order around the outline."""

    image: UInt8[np.ndarray, "frame_height frame_width 3"]
    window: Window
    box2d: tuple[float, float, float, float]
    hull: Float[np.ndarray, "n 2"] | None = None  # of this car; None: no 3-D box
    core: tuple[Float[np.ndarray, "_ 2"], ...] = ()  # outlines of parts of the box that any car fills
    occluders: tuple[Float[np.ndarray, "_ 2"], ...] = ()  # of nearer objects
    patch_id: str = ""
    frame_id: str = ""
    photo_path: str = ""  # of the photograph, relative to the source's root, with forward slashes
    truth_mask: bytes | None = None  # PNG of the window, where the source knows the exact mask


@dataclass(frozen=True)
class MaskResult:
    """Masks of the window; no pixel is both. `score`: the segmenter's confidence in [0, 1], None: it has none."""

    car: Bool[np.ndarray, "height width"]
    unknown: Bool[np.ndarray, "height width"]
    score: float | None = None


@runtime_checkable
class Segmenter(Protocol):
    """Finds the visible pixels of one car; can be pickled, gives the same mask each time it is asked."""

    def segment(self, request: SegmentRequest) -> MaskResult:
        """Masks of `request.window`; pixels of nearer objects are unknown."""


@runtime_checkable
class PhotoSegmenter(Protocol):
    """A segmenter that looks once at a photograph for all its cars (SAM: one image embedding)."""

    def segment_all(self, requests: Sequence[SegmentRequest]) -> list[MaskResult]:
        """Masks of each request's window; all requests are of one photograph."""


@runtime_checkable
class Detector(Protocol):
    """Finds vehicles in photographs; can be pickled. What one photograph gives does not depend on its company."""

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        """For each photograph its boxes, inside the photograph, in descending order of confidence."""


@runtime_checkable
class BoxEstimator(Protocol):
    """Finds 3-D boxes of vehicles in a photograph; can be pickled."""

    def estimate(self, photo: Photo) -> list[Detection3D]:
        """All boxes, in descending order of confidence where there is one."""
