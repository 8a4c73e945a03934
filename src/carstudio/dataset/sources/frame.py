"""What a source of photographs hands to the build: frames with their camera and labelled objects."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

from carstudio.errors import InputError

Vector3 = tuple[float, float, float]
# "exact" adds K^-1 P2[:, 3] to the labels' boxes; "as-released" leaves it out, for comparing with the released code
CameraOffset = Literal["exact", "as-released"]


@dataclass(frozen=True, kw_only=True)
class LabelledObject:
    """One labelled object of a frame; the three `box_*` are all None when it has no 3-D box."""

    patch_id: str
    instance_id: str
    type: str
    box2d: tuple[float, float, float, float]  # x0, y0, x1, y1 px in the frame
    box_center: Vector3 | None = None  # m, OpenCV camera, camera_offset applied
    box_size: Vector3 | None = None  # length, height, width, m
    box_yaw: float | None = None  # rad, KITTI rotation_y
    box_rotation: tuple[float, float, float, float] | None = None  # quaternion w, x, y, z where the box leans
    score_2d: float | None = None
    score_3d: float | None = None
    truncation: float | None = None
    occlusion: int | None = None
    truth_mask: bytes | None = None  # PNG of the crop, where the source knows the exact mask
    extra: dict[str, Any] = field(default_factory=dict)  # the source's own record


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One photograph. Intrinsics in px of the whole image, pixel centres at +0.5."""

    frame_id: str
    sequence_id: str | None = None
    frame_index: int | None = None
    image_path: str  # relative to the source's root, with forward slashes
    image: bytes
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy
    camera_offset: Vector3 = (0.0, 0.0, 0.0)  # m; X_camera = X_label_frame + camera_offset
    camera_source: str
    objects: tuple[LabelledObject, ...]  # labelled, or those that a detector has found
    labels: tuple[LabelledObject, ...] = ()  # the labelled ones, where `objects` are a detector's
    patch_prefix: str = ""  # of the patch ids of a detector's boxes
    instance_id: str | None = None  # of the photograph's one main car, where the source knows it
    licence: str | None = None  # of this photograph, where it differs from the source's
    extra: dict[str, Any] = field(default_factory=dict)  # what the source knows of the photograph
    problems: tuple[str, ...] = ()  # what could not be had, one sentence each


@dataclass(frozen=True)
class FrameRef:
    """Names a frame of a source without loading it."""

    sequence_id: str | None
    index: int
    stem: str  # file name without suffix


@runtime_checkable
class Source(Protocol):
    """A list of frames that can be loaded one by one, in any process (a source can be pickled)."""

    @property
    def name(self) -> str:
        """Value of the `source` column: "kitti-mot", ..."""

    @property
    def licence(self) -> str:
        """SPDX-like licence of the photographs."""

    @property
    def problems(self) -> tuple[str, ...]:
        """What was wrong with files that belong to no single frame."""

    def frames(self) -> Sequence[FrameRef]:
        """All frames asked for, in order."""

    def load(self, ref: FrameRef) -> Frame:
        """Read one frame; `InputError` when it is broken, which costs only this frame."""


def parse_frame_range(text: str | None) -> tuple[int, int] | None:
    """`A-B` (both included) or one number `A`; None stays None (all frames)."""
    if text is None:
        return None
    first, _, last = text.partition("-")
    if not first.isdecimal() or (last and not last.isdecimal()) or text.endswith("-"):
        raise InputError(f"--frames {text!r}: expected A-B with whole numbers, such as 0-24")
    start, stop = int(first), int(last or first)
    if stop < start:
        raise InputError(f"--frames {text!r}: expected A-B with A not above B, found {start} > {stop}")
    return start, stop
