"""KITTI tracking, official layout: image_02/SEQ/NNNNNN.png, label_02/SEQ.txt, calib/SEQ.txt.

A track is a physical car: instance `km-SEQ-TRACK`, its views in order of their frame number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from carstudio.dataset.schema import check_id
from carstudio.dataset.sources.frame import CameraOffset, Frame, FrameRef
from carstudio.dataset.sources.kitti_det import find_image, labelled_object, list_frames, require_frames
from carstudio.dataset.sources.kitti_format import (
    DONT_CARE,
    KITTI_LICENCE,
    KittiCalibration,
    TrackingLine,
    find_layout,
    group_tracking_lines,
    parse_calibration,
    parse_label,
    read_text,
)
from carstudio.errors import InputError
from carstudio.images import read_image_file


@dataclass(frozen=True)
class Drive:
    """Labels (by frame number, not parsed yet) and camera of one drive."""

    lines: Mapping[int, Sequence[TrackingLine]]
    calibration: KittiCalibration


@dataclass(frozen=True)
class KittiMotSource:
    """Frames of KITTI-MOT below `folder` (the one with image_02)."""

    folder: Path
    refs: tuple[FrameRef, ...]
    drives: Mapping[str, Drive]
    name: str = "kitti-mot"
    licence: str = KITTI_LICENCE
    problems: tuple[str, ...] = ()

    def frames(self) -> Sequence[FrameRef]:
        """The frames asked for, by sequence and number."""
        return self.refs

    def load(self, ref: FrameRef) -> Frame:
        """Read the image of one frame and parse its labels."""
        assert ref.sequence_id is not None
        drive = self.drives[ref.sequence_id]
        image = find_image(self.folder / "image_02" / ref.sequence_id, ref.stem)
        objects = []
        for line in drive.lines.get(ref.index, ()):
            label = parse_label(line.rest, where=line.where)
            if label.type == DONT_CARE:
                continue
            instance = f"km-{ref.sequence_id}-{line.track_id:03d}"
            patch = f"km-{ref.sequence_id}-{ref.stem}-{line.track_id:03d}"
            extra = {"frame": ref.index, "track": line.track_id}
            objects.append(labelled_object(label, drive.calibration, patch_id=patch, instance_id=instance, extra=extra))
        return Frame(
            frame_id=f"{ref.sequence_id}-{ref.stem}",
            sequence_id=ref.sequence_id,
            frame_index=ref.index,
            image_path=image.relative_to(self.folder).as_posix(),
            image=read_image_file(image),
            intrinsics=drive.calibration.intrinsics,
            camera_offset=drive.calibration.camera_offset,
            camera_source="calib:P2",
            patch_prefix=f"km-{ref.sequence_id}-{ref.stem}",
            objects=tuple(objects),
        )


def open_kitti_mot(
    root: Path, *, sequence: str | None = None, frames: str | None = None, camera_offset: CameraOffset = "exact"
) -> KittiMotSource:
    """One sequence, or all of them but the broken; `InputError` when there is none."""
    folder = find_layout(root, "image_02", "image_02/SEQ, label_02/SEQ.txt, calib/SEQ.txt")
    names = sorted(path.name for path in (folder / "image_02").iterdir() if path.is_dir())
    if sequence is not None and sequence not in names:
        raise InputError(f"{folder / 'image_02'}: no sequence {sequence!r}; there are {names}")
    chosen = names if sequence is None else [sequence]
    refs: list[FrameRef] = []
    drives: dict[str, Drive] = {}
    problems: list[str] = []
    for name in chosen:
        sequence_refs = list_frames(folder / "image_02" / name, frames, sequence_id=name)
        if not sequence_refs:
            continue
        try:
            check_id(name, "sequence")
            drives[name], found = _open_sequence(folder, name, camera_offset)
        except InputError as error:
            if sequence is not None:
                raise
            problems.append(f"sequence {name} skipped: {error}")
            continue
        refs += sequence_refs
        problems += found
    if problems and not refs:
        raise InputError(f"{folder}: no sequence can be read\n" + "\n".join(problems))
    refs_found = require_frames(refs, folder / "image_02", frames)
    return KittiMotSource(folder, refs_found, drives, problems=tuple(problems))


def _open_sequence(folder: Path, name: str, camera_offset: CameraOffset) -> tuple[Drive, tuple[str, ...]]:
    label_path, calib_path = folder / "label_02" / f"{name}.txt", folder / "calib" / f"{name}.txt"
    lines, problems = group_tracking_lines(read_text(label_path, "label file"), name=f"label_02/{label_path.name}")
    calibration = parse_calibration(
        read_text(calib_path, "calibration"), name=f"calib/{calib_path.name}", camera_offset=camera_offset
    )
    return Drive(lines, calibration), problems
