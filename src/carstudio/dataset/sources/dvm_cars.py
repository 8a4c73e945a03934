"""DVM-Cars (Huang et al., 2022), official layout: resized_DVM/MAKE/MODEL/YEAR/COLOUR/NAME.jpg and Image_table.csv.

NAME is MAKE$$MODEL$$YEAR$$COLOUR$$GENMODEL$$ADVERT$$image_N. A car is an advert (GENMODEL$$ADVERT): its photographs are
of one car. The table tells each photograph's viewpoint in degrees; the name of that column begins with a blank.
"""

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from carstudio.dataset.filters import EXPECTED_YAW
from carstudio.dataset.sources.cameras import CameraSpec, parse_camera
from carstudio.dataset.sources.frame import CameraOffset, Frame, FrameRef, parse_frame_range
from carstudio.errors import InputError
from carstudio.images import read_image_file

DVM_LICENCE = "unknown"  # its terms: academic use; the adverts' photographs belong to those who took them
TABLES = ("Image_table.csv", "tables/Image_table.csv", "tables_V2.0/Image_table.csv")
_PARTS = 7  # of a photograph's name
_SAFE = re.compile(r"[A-Za-z0-9_]+")
_IMAGE = re.compile(r"image_(\d{1,6})")


@dataclass(frozen=True)
class DvmPhoto:
    """One photograph; `viewpoint_deg` is the table's, None where it has none."""

    path: str  # relative to the root, with forward slashes
    advert: str  # GENMODEL-ADVERT
    number: int
    viewpoint_deg: float | None
    facts: tuple[str, str, str, str]  # make, model, year, colour


@dataclass(frozen=True)
class DvmCarsSource:
    """Photographs of adverts."""

    root: Path
    photos: tuple[DvmPhoto, ...]
    camera: CameraSpec
    problems: tuple[str, ...] = ()
    name: str = "dvm-cars"
    licence: str = DVM_LICENCE

    def frames(self) -> Sequence[FrameRef]:
        """All photographs by path; the sequence is the advert."""
        return tuple(
            FrameRef(photo.advert, index, f"{photo.advert}-{photo.number}") for index, photo in enumerate(self.photos)
        )

    def load(self, ref: FrameRef) -> Frame:
        """Read one photograph."""
        photo = self.photos[ref.index]
        image = read_image_file(self.root / photo.path)
        camera = self.camera.of(image, path=photo.path, frame_id=ref.stem)
        extra: dict[str, object] = dict(zip(("make", "model", "year", "colour"), photo.facts, strict=True))
        if photo.viewpoint_deg is not None:
            extra |= {"predicted_viewpoint_deg": photo.viewpoint_deg, EXPECTED_YAW: expected_yaw(photo.viewpoint_deg)}
        return Frame(
            frame_id=ref.stem,
            sequence_id=photo.advert,
            frame_index=photo.number,
            image_path=photo.path,
            image=image,
            intrinsics=camera.intrinsics,
            camera_offset=camera.offset,
            camera_source=camera.source,
            objects=(),
            patch_prefix=f"dv-{ref.stem}",
            instance_id=f"dv-{photo.advert}",
            extra=extra,
        )


def expected_yaw(viewpoint_deg: float) -> float:
    """KITTI's rotation_y (deg, in [-180, 180)) of a car that DVM calls seen from there, as released: 450 minus it."""
    return (450.0 - viewpoint_deg + 180.0) % 360.0 - 180.0


def open_dvm_cars(
    root: Path, *, camera: str = "paper", camera_offset: CameraOffset = "exact", frames: str | None = None
) -> DvmCarsSource:
    """The photographs below `root`; `InputError` when there are none or the table has not the columns it must have."""
    folder = root / "resized_DVM"
    if not folder.is_dir():
        raise InputError(f"{root}: no folder resized_DVM; expected resized_DVM/MAKE/MODEL/YEAR/COLOUR/*.jpg")
    viewpoints, problems = _read_viewpoints(root)
    photos = []
    for file in sorted(folder.glob("*/*/*/*/*.jpg")):
        photo = _photo(file, root, viewpoints)
        if photo is None:
            problems.append(
                f"{file.name}: expected MAKE$$MODEL$$YEAR$$COLOUR$$GENMODEL$$ADVERT$$image_N.jpg; photo skipped"
            )
        else:
            photos.append(photo)
    limits = parse_frame_range(frames)
    if limits is not None:
        photos = photos[limits[0] : limits[1] + 1]
    if not photos:
        raise InputError(f"{folder}: no photographs{'' if frames is None else f' within --frames {frames}'}")
    return DvmCarsSource(root, tuple(photos), parse_camera(camera, camera_offset), tuple(problems))


def _photo(file: Path, root: Path, viewpoints: dict[str, float]) -> DvmPhoto | None:
    parts = file.stem.split("$$")
    image = _IMAGE.fullmatch(parts[-1])
    if len(parts) != _PARTS or image is None or not all(_SAFE.fullmatch(part) for part in parts[4:6]):
        return None
    make, model, year, colour = parts[:4]
    return DvmPhoto(
        path=file.relative_to(root).as_posix(),
        advert=f"{parts[4]}-{parts[5]}",
        number=int(image[1]),
        viewpoint_deg=viewpoints.get(file.name),
        facts=(make, model, year, colour),
    )


def _read_viewpoints(root: Path) -> tuple[dict[str, float], list[str]]:
    """Viewpoints by the file's name, and what is wrong with rows that cannot be read."""
    path = next((root / name for name in TABLES if (root / name).is_file()), None)
    if path is None:
        return {}, [f"{root}: no {TABLES[0]}; the viewpoint rule does not apply"]
    viewpoints: dict[str, float] = {}
    problems = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            names = {name.strip(): name for name in reader.fieldnames or ()}
            missing = [name for name in ("Image_name", "Predicted_viewpoint") if name not in names]
            if missing:
                raise InputError(f"{path}: no column {' and '.join(missing)}; found {sorted(names)}")
            for row in reader:
                value, photo = row[names["Predicted_viewpoint"]], row[names["Image_name"]]
                try:
                    degrees = float(value)
                except (TypeError, ValueError):
                    degrees = math.nan
                if not photo or not math.isfinite(degrees):
                    where = f"{path} line {reader.line_num}"
                    problems.append(f"{where}: Predicted_viewpoint must be a number of degrees, found {value!r:.40}")
                    continue
                viewpoints[photo.strip()] = degrees
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: expected DVM-Cars' image table as CSV ({error})") from error
    return viewpoints, problems
