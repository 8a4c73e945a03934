"""KITTI object detection, official layout: image_2/NNNNNN.png, label_2/NNNNNN.txt, calib/NNNNNN.txt.

A car has no identity across images here: each patch is its own instance.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from carstudio.dataset.sources.frame import CameraOffset, Frame, FrameRef, LabelledObject, parse_frame_range
from carstudio.dataset.sources.kitti_format import (
    DONT_CARE,
    KITTI_LICENCE,
    KittiCalibration,
    KittiLabel,
    center_in_camera,
    find_layout,
    parse_calibration,
    parse_labels,
    read_text,
)
from carstudio.errors import InputError
from carstudio.images import read_image_file

_NUMBERED = re.compile(r"\d{1,9}", re.ASCII)  # fits 32 bits
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class KittiDetSource:
    """Frames of KITTI-DET below `folder` (the one with image_2)."""

    folder: Path
    refs: tuple[FrameRef, ...]
    name: str = "kitti-det"
    licence: str = KITTI_LICENCE
    problems: tuple[str, ...] = ()
    camera_offset: CameraOffset = "exact"

    def frames(self) -> Sequence[FrameRef]:
        """The frames asked for, by number."""
        return self.refs

    def load(self, ref: FrameRef) -> Frame:
        """Read image, labels and calibration of one frame."""
        image = find_image(self.folder / "image_2", ref.stem)
        label_path, calib_path = self.folder / "label_2" / f"{ref.stem}.txt", self.folder / "calib" / f"{ref.stem}.txt"
        labels = parse_labels(read_text(label_path, "label file"), name=label_path.name)
        calibration = parse_calibration(
            read_text(calib_path, "calibration"), name=f"calib/{calib_path.name}", camera_offset=self.camera_offset
        )
        objects = [
            labelled_object(label, calibration, patch_id=f"ko-{ref.stem}-{number:03d}", extra={"line": number})
            for number, label in enumerate(labels)
            if label.type != DONT_CARE
        ]
        return Frame(
            frame_id=ref.stem,
            image_path=image.relative_to(self.folder).as_posix(),
            image=read_image_file(image),
            intrinsics=calibration.intrinsics,
            camera_offset=calibration.camera_offset,
            camera_source="calib:P2",
            patch_prefix=f"ko-{ref.stem}",
            objects=tuple(objects),
        )


def open_kitti_det(root: Path, *, frames: str | None = None, camera_offset: CameraOffset = "exact") -> KittiDetSource:
    """The frames with an image; `InputError` when there are none."""
    folder = find_layout(root, "image_2", "image_2, label_2, calib")
    refs = list_frames(folder / "image_2", frames)
    return KittiDetSource(folder, require_frames(refs, folder / "image_2", frames), camera_offset=camera_offset)


def list_frames(folder: Path, frames: str | None, sequence_id: str | None = None) -> tuple[FrameRef, ...]:
    """The numbered images of a folder within `frames` (A-B), in order of their number."""
    limits = parse_frame_range(frames)
    images = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    stems = {path.stem for path in images if _NUMBERED.fullmatch(path.stem)}
    refs = [FrameRef(sequence_id, int(stem), stem) for stem in stems]
    if limits is not None:
        refs = [ref for ref in refs if limits[0] <= ref.index <= limits[1]]
    return tuple(sorted(refs, key=lambda ref: (ref.index, ref.stem)))


def require_frames(refs: Sequence[FrameRef], folder: Path, frames: str | None) -> tuple[FrameRef, ...]:
    """`refs`, or `InputError` when there are none."""
    if not refs:
        wanted = "" if frames is None else f" within --frames {frames}"
        raise InputError(f"{folder}: no numbered images{wanted}; expected NNNNNN.png")
    return tuple(refs)


def find_image(folder: Path, stem: str) -> Path:
    """The image of a frame, whatever its suffix."""
    for suffix in IMAGE_SUFFIXES:
        for path in (folder / f"{stem}{suffix}", folder / f"{stem}{suffix.upper()}"):
            if path.is_file():
                return path
    raise InputError(f"{folder}: no image {stem}.png")


def labelled_object(
    label: KittiLabel,
    calibration: KittiCalibration,
    *,
    patch_id: str,
    instance_id: str | None = None,
    extra: dict[str, int],
) -> LabelledObject:
    """A KITTI label as the build wants it; without `instance_id` the patch is its own instance."""
    return LabelledObject(
        patch_id=patch_id,
        instance_id=instance_id or patch_id,
        type=label.type,
        box2d=label.box2d,
        box_center=center_in_camera(label, calibration.camera_offset),
        box_size=label.size,
        box_yaw=None if label.size is None else label.yaw_rad,
        score_2d=label.score,
        truncation=label.truncation,
        occlusion=label.occlusion,
        extra={"type": label.type, "label": label.line, **extra},
    )
