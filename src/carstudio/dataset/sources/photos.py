"""Photographs of any origin: no labels, a camera as good as can be had."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from carstudio.dataset.schema import check_id
from carstudio.dataset.sources.cameras import CameraSpec, parse_camera
from carstudio.dataset.sources.frame import CameraOffset, Frame, FrameRef, parse_frame_range
from carstudio.dataset.sources.photo_files import PhotoFile, find_photos, read_photo
from carstudio.errors import InputError

UNKNOWN_LICENCE = "unknown"


@dataclass(frozen=True)
class PhotosSource:
    """A list of photographs; each one's cars are found by a detector."""

    files: tuple[PhotoFile, ...]
    camera: CameraSpec
    name: str = "photos"
    licence: str = UNKNOWN_LICENCE
    problems: tuple[str, ...] = ()
    own_cameras: dict[str, CameraSpec] = field(default_factory=dict)  # by spec: those that a list gives

    def frames(self) -> Sequence[FrameRef]:
        """All photographs in their order; the number counts them from 0."""
        return tuple(FrameRef(None, number, file.frame_id) for number, file in enumerate(self.files))

    def load(self, ref: FrameRef) -> Frame:
        """Read one photograph and tell its camera."""
        file = self.files[ref.index]
        image = read_photo(file.location)
        spec = self.camera if file.camera is None else self.own_cameras[file.camera]
        camera = spec.of(image, path=file.path, frame_id=file.frame_id)
        return Frame(
            frame_id=file.frame_id,
            frame_index=ref.index,
            image_path=file.path,
            image=image,
            intrinsics=camera.intrinsics,
            camera_offset=camera.offset,
            camera_source=camera.source,
            objects=(),
            patch_prefix=f"ph-{file.frame_id}",
            instance_id=file.instance_id,
            licence=file.licence,
        )


def open_photos(
    root: str,
    *,
    camera: str = "exif",
    camera_offset: CameraOffset = "exact",
    frames: str | None = None,
    licence: str | None = None,
) -> PhotosSource:
    """The photographs that `root` names; `InputError` when there are none, or a list says what cannot be."""
    files = find_photos(root)
    limits = parse_frame_range(frames)
    if limits is not None:
        files = files[limits[0] : limits[1] + 1]
        if not files:
            raise InputError(f"{root}: no photographs within --frames {frames}")
    for file in files:
        if file.instance_id is not None:
            check_id(file.instance_id, f"instance_id of {file.path}")
    specs = {file.camera for file in files if file.camera is not None}
    return PhotosSource(
        files,
        parse_camera(camera, camera_offset),
        licence=licence or UNKNOWN_LICENCE,
        own_cameras={spec: parse_camera(spec, camera_offset) for spec in sorted(specs)},
    )
