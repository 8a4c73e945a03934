"""Cameras of photographs: EXIF written by hand, KITTI's calibration, given numbers, and the rough ones."""

import io
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from carstudio.dataset.sources.cameras import FrameCamera, parse_camera
from carstudio.errors import InputError
from carstudio.images import decode_image

F35, FOCAL, PLANE_X, PLANE_UNIT, PIXELS_X, PIXELS_Y = 0xA405, 0x920A, 0xA20E, 0xA210, 0xA002, 0xA003


def jpeg(width: int, height: int, tags: dict[int, object] | None = None, orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(tags or {})
    out = io.BytesIO()
    Image.fromarray(np.zeros((height, width, 3), np.uint8)).save(out, "JPEG", exif=exif)
    return out.getvalue()


def camera(spec: str, image: bytes) -> FrameCamera:
    return parse_camera(spec).of(image, path="a.jpg", frame_id="a")


def test_the_35_mm_equivalent_gives_the_field_of_view_of_film() -> None:
    """A 50 mm lens on film sees 46.8 degrees along the diagonal, whatever the sensor's shape and resolution."""
    for width, height in ((4000, 3000), (1200, 800), (300, 300)):
        found = camera("exif", jpeg(width, height, {F35: 50}))
        assert found.source == "exif:35mm"
        view = 2 * math.degrees(math.atan(math.hypot(width, height) / 2 / found.intrinsics[0]))
        assert view == pytest.approx(46.793, abs=1e-3)
        assert found.intrinsics[2:] == (width / 2, height / 2)
    assert camera("exif", jpeg(3600, 2400, {F35: 36})).intrinsics[0] == pytest.approx(3600)  # 36 mm wide film


def test_a_turned_photograph_keeps_its_focal_length() -> None:
    flat, turned = jpeg(4000, 3000, {F35: 26}), jpeg(4000, 3000, {F35: 26}, orientation=6)
    assert decode_image(turned, name="a").shape[:2] == (4000, 3000)
    fx, fy, cx, cy = camera("exif", turned).intrinsics
    assert (fx, fy) == camera("exif", flat).intrinsics[:2]
    assert (cx, cy) == (1500, 2000)


@pytest.mark.parametrize(("unit", "per_unit"), [(2, 25.4), (3, 10.0), (4, 1.0)])
def test_the_focal_plane_resolution_gives_pixels(unit: int, per_unit: float) -> None:
    """A 23.4 mm wide sensor of 6000 px behind a 35 mm lens, the photograph scaled to a quarter."""
    tags: dict[int, object] = {
        FOCAL: IFDRational(35, 1),
        PLANE_X: IFDRational(round(6000 / 23.4 * per_unit * 1000), 1000),
        PLANE_UNIT: unit,
        PIXELS_X: 6000,
        PIXELS_Y: 4000,
    }
    found = camera("exif", jpeg(1500, 1000, tags))
    assert found.source == "exif:focal-plane"
    assert found.intrinsics[0] == pytest.approx(35 / 23.4 * 1500, rel=1e-4)


NO_LENS = {
    "no EXIF": {},
    "zero": {F35: 0},
    "a fisheye that this is not": {F35: 1},
    "a telescope": {F35: 20000},
    "no pixels": {FOCAL: IFDRational(35, 1), PLANE_X: IFDRational(100, 1), PLANE_UNIT: 2},
    "division by zero": {FOCAL: IFDRational(35, 0), F35: 0},
    "cropped": {F35: 26, PIXELS_X: 4000, PIXELS_Y: 3000},
}


@pytest.mark.parametrize("why", NO_LENS)
def test_without_credible_exif_kittis_field_of_view_is_assumed(why: str) -> None:
    """1242 px wide it is KITTI's focal length; other widths, and photos held upright, have the same field of view."""
    for width, height, focal in ((1242, 375, 721.5377), (600, 300, 721.5377 * 600 / 1242)):
        found = camera("exif", jpeg(width, height, NO_LENS[why]))  # type: ignore[arg-type]  # tags of any type
        assert (found.source, found.intrinsics[0]) == ("assumed:kitti-fov", pytest.approx(focal))
    assert camera("exif", jpeg(300, 600)).intrinsics[0] == pytest.approx(721.5377 * 600 / 1242)


def test_rough_and_given_cameras() -> None:
    image = jpeg(300, 300, {F35: 26})
    assert camera("paper", image) == FrameCamera((721.5377, 721.5377, 150.0, 150.0), "paper")
    assert camera("500", image) == FrameCamera((500.0, 500.0, 150.0, 150.0), "given")
    assert camera("500,501,140.5,160", image) == FrameCamera((500.0, 501.0, 140.5, 160.0), "given")


CALIBRATION = "P2: 700 0 600 45 0 700 180 -0.3 0 0 1 0.005\n"


def test_calibrations_of_a_folder_a_subfolder_or_one_file(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "a.txt").write_text(CALIBRATION)
    (tmp_path / "b.txt").write_text(CALIBRATION.replace("700", "800"))
    spec = parse_camera(f"calib:{tmp_path}")
    assert spec.of(b"", path="x/a.jpg", frame_id="x-a").intrinsics == (700, 700, 600, 180)
    assert spec.of(b"", path="y/b.jpg", frame_id="b").intrinsics == (800, 800, 600, 180)
    found = parse_camera(f"calib:{tmp_path}/b.txt").of(b"", path="y/c.jpg", frame_id="c")
    assert (found.source, found.intrinsics[0]) == ("calib:P2", 800)
    assert found.offset == pytest.approx(((45 - 600 * 0.005) / 800, (-0.3 - 180 * 0.005) / 800, 0.005))
    released = parse_camera(f"calib:{tmp_path}/b.txt", "as-released").of(b"", path="y/c.jpg", frame_id="c")
    assert released.offset == (0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=r"no calibration z/q\.txt of this photograph"):
        spec.of(b"", path="z/q.jpg", frame_id="z-q")
    with pytest.raises(InputError, match="passwd"):
        spec.of(b"", path="../../etc/passwd.jpg", frame_id="p")


@pytest.mark.parametrize(
    "text", ["", "0", "-5", "1,2,3", "1,2,3,4,5", "nan", "1e400", "exif:x", "calib:", "7..7", "calib"]
)
def test_other_specs_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected one of exif, paper, FOCAL_PX, FX,FY,CX,CY, calib:PATH"):
        parse_camera(text)


def test_a_calibration_that_is_not_there_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder; expected KITTI calibrations"):
        parse_camera(f"calib:{tmp_path}/absent")
