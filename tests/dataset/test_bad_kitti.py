"""KITTI folders as people have them: broken lines, calibrations and photographs cost themselves, never the build."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from carstudio.cli import run
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.sources.kitti_format import group_tracking_lines, parse_calibration, parse_label, read_text
from carstudio.dataset.sources.kitti_mot import open_kitti_mot
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.images import encode_png
from dataset.made_up_kitti import HEIGHT, P2, WIDTH, car_line, made_up_kitti

CAR = "Car 0.34 1 -1.57 600.0 170.5 700.0 250.25 1.5 1.7 4.2 2.0 1.65 20.0 -1.4"


@pytest.mark.parametrize("word", ["1_0", "٣", "inf", "-nan", "0x10", "1,5", "1e999", "--1", "True"])
def test_what_only_python_takes_for_a_number_is_refused(word: str) -> None:
    with pytest.raises(InputError, match="line 4: x must be a finite number, found ") as caught:
        parse_label(CAR.replace(" 2.0 ", f" {word} "), where="000123.txt line 4")
    assert repr(word) in str(caught.value)


@pytest.mark.parametrize(("word", "value"), [("2", 2.0), ("-.5", -0.5), ("+3.", 3.0), ("7.5e+01", 75.0), ("1E-1", 0.1)])
def test_every_usual_spelling_of_a_number_is_read(word: str, value: float) -> None:
    label = parse_label(CAR.replace(" 2.0 ", f" {word} "), where="x")
    assert label.bottom_center is not None
    assert label.bottom_center[0] == value


def test_tracks_without_identity_are_skipped_and_named() -> None:
    dont_care = "DontCare -1 -1 -10 1 2 30 40 -1 -1 -1 -1000 -1000 -1000 -10"
    text = f"0 -1 {CAR}\n0 -1 {dont_care}\n0 {'9' * 30} {CAR}\n1_0 2 {CAR}\n3 4 {CAR}\n"
    frames, problems = group_tracking_lines(text, name="label_02/0001.txt")
    assert {frame: [line.track_id for line in lines] for frame, lines in frames.items()} == {0: [-1], 3: [4]}
    assert problems[0] == (
        "label_02/0001.txt line 1: track must be 0 or more (-1 is for DontCare), found -1; line skipped"
    )
    assert [problem.split(":")[0][-6:] for problem in problems[1:]] == ["line 3", "line 4"]


def test_lines_are_counted_as_editors_do() -> None:
    _, problems = group_tracking_lines(f"0 1 {CAR}\x0c\n0 2 {CAR}\u2028\nbroken\n", name="f")
    assert [problem.split(":")[0] for problem in problems] == ["f line 3"]


def test_the_mark_of_windows_editors_hides_nothing(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_bytes(b"\xef\xbb\xbfP2: 700 0 600 0 0 700 180 0 0 0 1 0\r\n")
    assert parse_calibration(read_text(tmp_path / "calib.txt", "calibration"), name="c").intrinsics[0] == 700.0


BROKEN_CALIBRATIONS = {
    "calib/1.txt line 2: number 12 of P2 must be a finite number, found 'nan'": "7 0 6 0 0 7 1 0 0 0 1 nan",
    "calib/1.txt line 2: number 4 of P2 must be a finite number, found 'inf'": "7 0 6 inf 0 7 1 0 0 0 1 0",
    "calib/1.txt line 2: P2 must have 12 numbers (3 x 4, row by row), found 0": "",
    "calib/1.txt line 2: P2 must have positive focal lengths, found (-7.0, 7.0) px": "-7 0 6 0 0 7 1 0 0 0 1 0",
    "calib/1.txt line 2: P2 must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
    "7 7 6 0 7 7 1 0 0 0 1 0": "7 7 6 0 7 7 1 0 0 0 1 0",  # singular
    "calib/1.txt line 2: P2 must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
    "7 0 6 0 0 7 1 0 0 0 0 0": "7 0 6 0 0 7 1 0 0 0 0 0",
    "calib/1.txt line 2: P2 must be fx 0 cx tx, 0 fy cy ty, 0 0 1 tz (a rectified camera), found "
    "7 0 6 0 0 7 1 0 0 0 2 0": "7 0 6 0 0 7 1 0 0 0 2 0",  # in other units
}


@pytest.mark.parametrize(("message", "numbers"), BROKEN_CALIBRATIONS.items())
def test_broken_calibrations_are_explained(message: str, numbers: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_calibration(f"P0: 7 0 6 0 0 7 1 0 0 0 1 0\nP2: {numbers}\n", name="calib/1.txt")
    assert str(caught.value) == message


FAR_AWAY = "1.5 1.8 4.0 0 1 -6 0"  # height width length, centre 6 m behind the camera
BOX = "10 10 90 100"
ODD_OBJECTS = {  # a label's rest -> the first filter it fails
    f"Car 0 0 0 {BOX} {FAR_AWAY}": "box_iou",  # behind the camera
    f"Car 0 0 0 {BOX} 1.5 1.8 4.0 0 1 0 0": "box_iou",  # the camera is inside
    f"Car 0 0 0 {BOX} 1.5 1.8 4.0 9e5 1 6 0": "box_iou",  # far outside the picture
    f"Car 0 0 0 {BOX} 1.5 1.8 9e5 0 1 6 0": "box_iou",
    f"Car 0 0 0 {BOX} 1e-300 1e-300 1e-300 0 1 6 0": "box_iou",
    f"Car 0 0 0 {BOX} 1.5 1.8 4.0 0 1 9e5 0": "depth_m",
    f"Car 0 0 0 {BOX} -1 -1 -1 -1000 -1000 -1000 -10": "box3d",
    "Car 0 0 0 -9e5 10 9e5 100 1.5 1.8 4.0 0 1 6 0": "box_iou",  # wider than any picture
    "Car 0 0 0 10.2 10.2 10.7 10.7 1.5 1.8 4.0 0 1 6 0": "height_px",  # less than a pixel
}


@pytest.mark.parametrize(("rest", "reason"), ODD_OBJECTS.items())
def test_impossible_boxes_become_records_with_a_verdict(tmp_path: Path, rest: str, reason: str) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    labels = f"0 1 {rest}\n1 7 {car_line(0.1, 5.0)}\n"
    (root / "training" / "label_02" / "0000.txt").write_text(labels)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert summary.problems == ()
    store = open_store(tmp_path / "s")
    assert store.verify() == []
    assert {verdict.patch_id: verdict.reason for verdict in store.verdicts()}["km-0000-000000-001"] == reason


@pytest.mark.parametrize("box", ["300 10 390 100", "-90 -100 -10 -20", "10 120.5 90 300"])
def test_a_box_outside_the_photo_costs_only_its_object(tmp_path: Path, box: str) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    labels = f"0 1 Car 0 0 0 {box} 1.5 1.8 4.0 0 1 6 0\n0 2 {car_line(0.0, 6.0)}\n"
    (root / "training" / "label_02" / "0000.txt").write_text(labels)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert summary.candidates == 1
    (problem,) = summary.problems
    assert problem.startswith("km-0000-000000-001: 2-D box (")
    assert problem.endswith(f"lies outside the photograph of {WIDTH} x {HEIGHT} px")


def test_an_object_named_twice_costs_only_itself(tmp_path: Path) -> None:
    """The store refuses an id that it holds; that must not end a build of hours."""
    root = made_up_kitti(tmp_path / "kitti")
    labels = f"0 1 {car_line(0.0, 6.0)}\n0 1 {car_line(1.0, 8.0)}\n1 1 {car_line(0.0, 6.0)}\n"
    (root / "training" / "label_02" / "0000.txt").write_text(labels)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert summary.candidates == 2
    assert summary.problems == (
        "km-0000-000000-001: the frame has this object twice (one frame, one track); the first is kept",
    )


def test_a_sequence_whose_name_cannot_be_an_id_is_told(tmp_path: Path) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    for folder, ending in (("image_02", ""), ("label_02", ".txt"), ("calib", ".txt")):
        place = root / "training" / folder
        (place / f"0000{ending}").rename(place / f"my drive{ending}")
    with pytest.raises(InputError, match="sequence 'my drive': expected 1 to 100 letters"):
        build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))


def test_a_broken_sequence_costs_only_itself(tmp_path: Path) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    training = root / "training"
    (training / "image_02" / "0001").mkdir()
    (training / "image_02" / "0001" / "000000.png").write_bytes(encode_png(np.zeros((4, 4, 3), np.uint8)))
    source = open_kitti_mot(root)
    assert {ref.sequence_id for ref in source.frames()} == {"0000"}
    (problem,) = source.problems
    assert problem.startswith(
        f"sequence 0001 skipped: {training}/label_02/0001.txt: label file cannot be read (No such"
    )
    with pytest.raises(InputError, match=r"^\S+label_02/0001\.txt: label file cannot be read"):
        open_kitti_mot(root, sequence="0001")
    (training / "calib" / "0000.txt").write_text("nothing")
    with pytest.raises(InputError, match=r"(?s)no sequence can be read\n.*0000 skipped.*\n.*0001 skipped"):
        open_kitti_mot(root)


def test_numbers_beyond_32_bits_are_no_frames(tmp_path: Path) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    folder = root / "training" / "image_02" / "0000"
    for stem in ("99999999999", "٠٠٠٠٠٩"):
        (folder / f"{stem}.png").write_bytes((folder / "000000.png").read_bytes())
    assert {ref.stem for ref in open_kitti_mot(root).frames()} == {"000000", "000001", "000002"}


def bad_photos(folder: Path, first: int) -> dict[str, str]:
    """Broken photographs of frames `first`, ...; returns what a build must say of each."""
    good = (folder / f"{first:06d}.png").read_bytes()
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    bomb = good[:16] + struct.pack(">II", 60_000, 60_000) + good[24:]
    contents = {
        "found an empty file": b"",
        "broken or truncated": good[: len(good) // 2],
        "bad header checksum": bytes(flipped),
        "begins with b'<html>": b"<html>404 not found</html>",
        "begins with b'%!PS": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 240 120\n",
        "image_02/0000/": bomb,
    }
    said = {}
    for frame, (message, data) in enumerate(contents.items(), start=first):
        (folder / f"{frame:06d}.png").write_bytes(data)
        said[f"{frame:06d}"] = message
    frame = first + len(contents)
    (folder / f"{frame:06d}.png").unlink()
    (folder / f"{frame:06d}.png").symlink_to(folder / "nowhere.png")
    return said | {f"{frame:06d}": "no image"}


def odd_photos(folder: Path, first: int) -> list[str]:
    """Unusual photographs that are read; returns their frames."""
    photo = Image.fromarray(np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8))
    (folder / f"{first:06d}.png").unlink()
    photo.convert("CMYK").save(folder / f"{first:06d}.jpg", "JPEG")
    photo.convert("L").save(folder / f"{first + 1:06d}.png")
    photo.quantize(64).save(folder / f"{first + 2:06d}.png", transparency=3)
    exif = Image.Exif()
    exif[0x0112] = 6
    photo.rotate(90, expand=True).save(folder / f"{first + 3:06d}.png", exif=exif)
    photo.save(folder / f"{first + 4:06d}.png", "GIF", save_all=True, append_images=[photo.convert("L")])
    deep = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)
    (folder / f"{first + 5:06d}.png").write_bytes(encode_png(deep))
    return [f"{frame:06d}" for frame in range(first, first + 6)]


def test_a_folder_full_of_bad_files_is_built_and_every_problem_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = made_up_kitti(tmp_path / "kitti", more_frames=20)
    folder = root / "training" / "image_02" / "0000"
    said = bad_photos(folder, 5)
    odd = odd_photos(folder, 14)
    command = ["build", "kitti-mot", "--root", str(root), "--out", str(tmp_path / "s"), "--workers", "1", "--json"]
    assert run(command) == 0
    summary = json.loads(capsys.readouterr().out)
    problems = {problem.split()[1]: problem for problem in summary["problems"]}
    assert problems.keys() == {"000002", *said}
    for frame, message in said.items():
        assert problems[frame].startswith(f"frame {frame} skipped: ")
        assert message in problems[frame]
        assert f"{frame}.png" in problems[frame]
    store = open_store(tmp_path / "s")
    assert store.verify() == []
    frames = {record.frame_id.split("-")[1] for record in store.light_records()}
    assert frames == {f"{frame:06d}" for frame in range(23)} - problems.keys()
    assert set(odd) < frames
    turned = store.record("km-0000-000017-007")
    assert (turned.frame_width, turned.frame_height) == (WIDTH, HEIGHT)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="permissions hold back nobody here")
def test_a_photo_that_may_not_be_read_costs_only_its_frame(tmp_path: Path) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    (root / "training" / "image_02" / "0000" / "000000.png").chmod(0)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert "000000.png: image cannot be read (Permission denied)" in summary.problems[0]


def test_a_photo_that_the_disk_does_not_give_costs_only_its_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    usual = Path.open

    def broken_disk(path: Path, *arguments: object, **options: object) -> object:
        if path.name == "000000.png":
            raise OSError(5, "Input/output error", str(path))
        return usual(path, *arguments, **options)  # type: ignore[arg-type]  # handed through

    monkeypatch.setattr(Path, "open", broken_disk)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert summary.candidates == 1
    assert "000000.png: image cannot be read (Input/output error); replace or remove it" in summary.problems[0]


def test_a_photo_file_of_absurd_length_is_refused(tmp_path: Path) -> None:
    """A sparse file: no disk is used; reading all of it would end the process for want of memory."""
    root = made_up_kitti(tmp_path / "kitti")
    with (root / "training" / "image_02" / "0000" / "000000.png").open("wb") as file:
        file.truncate(2**36)
    summary = build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "s", workers=1))
    assert "image must be of at most 480,000,000 bytes, found 68,719,476,736" in summary.problems[0]


def test_a_calibration_that_fails_in_one_frame_costs_only_that(tmp_path: Path) -> None:
    root = tmp_path / "kitti-obj"
    for name in ("image_2", "label_2", "calib"):
        (root / name).mkdir(parents=True)
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    calibrations = {"0": P2, "1": P2.replace("P2", "P3"), "2": P2 + " 7", "3": "\0\xff", "4": P2}
    for stem, text in calibrations.items():
        (root / "image_2" / f"{stem}.png").write_bytes(encode_png(pixels))
        (root / "label_2" / f"{stem}.txt").write_text(car_line(0.0, 6.0))
        (root / "calib" / f"{stem}.txt").write_text(text, encoding="latin-1")
    (root / "label_2" / "4.txt").unlink()
    summary = build(BuildConfig(source="kitti-det", root=root, out=tmp_path / "s", workers=1))
    assert summary.candidates == 1
    found = {problem.split()[1]: problem.split(" skipped: ")[1] for problem in summary.problems}
    assert found["1"] == "calib/1.txt: no line P2; expected a KITTI calibration file with P0 to P3"
    assert found["2"] == "calib/2.txt line 1: P2 must have 12 numbers (3 x 4, row by row), found 13"
    assert "3.txt: expected calibration as UTF-8 text, found binary data" in found["3"]
    assert "4.txt: label file cannot be read (No such file or directory); restore it" in found["4"]
