"""A broken record costs only itself; its problem says which, what was expected and what was found."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from carstudio.commands.build import describe
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.legacy_json import convert
from carstudio.dataset.store import open_store
from carstudio.dataset.summary import BuildSummary
from carstudio.errors import InputError
from dataset.authors_files import Exactly, as_text, make_records, write_pictures

Change = Callable[[dict[str, Any]], Any]


def changed(**changes: Any) -> Change:
    return lambda record: record | changes


def without(key: str) -> Change:
    return lambda record: {name: value for name, value in record.items() if name != key}


BAD_RECORDS: list[tuple[str, Change, str]] = [
    ("missing key", without("obj_y"), "the keys obj_y are missing; only w, h and the distortion may be left out"),
    ("no object", lambda record: [1, 2], "expected an object with the keys patch, mask, image_file"),
    ("null", lambda record: None, "found None"),
    ("NaN", changed(yaw=float("nan")), "yaw must be a finite number of at most 1e+09, found nan"),
    ("infinite", changed(fl_x=Exactly("1e999")), "fl_x must be a finite number of at most 1e+09, found inf"),
    ("NaN unused", changed(k1=float("nan")), "expected numbers as JSON knows them, found NaN under a key"),
    ("text", changed(cx="609"), "cx must be a finite number of at most 1e+09, found '609'"),
    ("truth", changed(cam_tz=True), "cam_tz must be a finite number of at most 1e+09, found True"),
    ("huge integer", changed(obj_x=10**300), "obj_x must be a finite number of at most 1e+09, found an integer"),
    ("negative size", changed(width=-1.6), "length, height, width must be at least 0.001, in metres, found (3.88"),
    ("tiny size", changed(height=1e-300), "length, height, width must be at least 0.001, in metres"),
    ("no focal length", changed(fl_y=0), "fl_x and fl_y must be at least 0.001, in px, found (721.5377, 0.0)"),
    ("inverted box", changed(xmin=700, xmax=600.5), "xmin <= xmax and ymin <= ymax in px, found (700.0,"),
    ("box outside", changed(xmin=-90, xmax=-20), "lies left of or above the photograph"),
    ("box beyond", changed(xmin=1e6, xmax=1e6 + 9), "lies outside the photograph of 1242 x 375 px"),
    ("w alone", without("h"), "expected both w and h or neither, found one of them"),
    ("broken w", changed(w=1242.5), "w and h must be whole numbers from 1 to 1000000 px, found (1242.5, 375.0)"),
    ("no patch file", changed(patch="patch/none_patch.png"), "patch/none_patch.png: no such file below"),
    ("a folder", changed(patch="patch"), "patch: no such file below"),
    ("other size", changed(xmin=600.25), "px; expected 43 x 38 px, xmin to xmax and ymin to ymax truncated to int"),
    ("climbing", changed(patch="patch/../../secret.png"), "path 'patch/../../secret.png' leaves its folder"),
    ("absolute", changed(mask="/etc/hostname"), "path '/etc/hostname' leaves its folder"),
    ("link", changed(patch="patch/link.png"), "path 'patch/link.png' leaves its folder"),
    ("circle", changed(patch="patch/circle.png"), "patch/circle.png"),
    ("long name", changed(patch="patch/" + "x" * 900 + ".png"), "cannot be read"),
    ("very long name", changed(patch="x" * 5000), "patch must be a path of 1 to 1024 whole characters, found 'xxx"),
    ("half a surrogate", changed(image_file="\ud800.png"), r"must be a path of 1 to 1024 whole characters, found '\u"),
    ("zero byte", changed(patch="a\0b"), r"patch must be a path of 1 to 1024 whole characters, found 'a\x00b'"),
    ("empty path", changed(mask=""), "mask must be a path of 1 to 1024 whole characters, found ''"),
    ("no path", changed(mask=None), "mask must be a path of 1 to 1024 whole characters, found None"),
    ("empty file", changed(patch="patch/empty.png"), "patch/empty.png: expected an image, found an empty file"),
    ("no image", changed(patch="km.json"), "km.json: expected an image (PNG, JPEG,"),
    ("cut off", changed(patch="patch/cut.png"), "patch/cut.png: image is broken or truncated"),
    ("16 bit mask", changed(mask="mask/deep.png"), "mask/deep.png: expected a mask of 8 bits per channel, found 16"),
    ("large file", changed(patch="patch/large.png"), "patch/large.png: 300000 bytes, at most 200000 are read"),
]  # fmt: skip


def write_files(folder: Path, text_of: Callable[[list[dict[str, Any]]], str]) -> Path:
    """km.json with `text_of` its records, and beside it files of many faults."""
    root = folder / "car_studio"
    records = make_records("km")
    write_pictures(root, "km", records)
    good = root / records[1]["patch"]
    width, height = Image.open(good).size
    (folder / "secret.png").write_bytes(good.read_bytes())
    (root / "patch" / "link.png").symlink_to(folder / "secret.png")
    (root / "patch" / "circle.png").symlink_to(root / "patch" / "circle.png")
    (root / "patch" / "empty.png").write_bytes(b"")
    (root / "patch" / "cut.png").write_bytes(good.read_bytes()[:-400])
    (root / "patch" / "large.png").write_bytes(good.read_bytes() + bytes(300_000 - good.stat().st_size))
    Image.fromarray(np.ones((height, width), np.uint16)).save(root / "mask" / "deep.png")
    (root / "km.json").write_text(text_of(records), encoding="utf-8", newline="")
    return root


def build_files(root: Path, out: Path, **changes: Any) -> BuildSummary:
    return build(BuildConfig(source="legacy-json", root=root, out=out, workers=1, **changes))


@pytest.mark.parametrize(("name", "change", "message"), BAD_RECORDS, ids=[name for name, _, _ in BAD_RECORDS])
def test_a_bad_record_costs_only_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, change: Change, message: str
) -> None:
    monkeypatch.setattr(convert, "MAX_PICTURE_BYTES", 200_000)

    def text_of(records: list[dict[str, Any]]) -> str:
        records[1] = change(records[1])
        return as_text({"dataset_name": "km", "instances": records})

    summary = build_files(write_files(tmp_path, text_of), tmp_path / "store")
    assert (summary.candidates, summary.kept, len(summary.problems)) == (3, 3, 1)
    assert summary.problems[0].startswith("km.json instances[1] skipped: ")
    assert message in summary.problems[0]
    assert len(summary.problems[0]) < 1500
    assert open_store(tmp_path / "store").verify() == []


def test_a_hundred_problems_do_not_flood_the_terminal(tmp_path: Path) -> None:
    text = '{"dataset_name": "km", "instances": [' + ",".join(["{}"] * 100) + "]}"
    summary = build_files(write_files(tmp_path, lambda _: text), tmp_path / "store")
    assert len(summary.problems) == 100
    lines = describe(summary).splitlines()
    assert len(lines) < 30
    assert lines[-1] == "  ... and 80 more problems; --json lists them all"


BAD_ROOTS = [
    (
        "nowhere",
        {},
        "nowhere: expected the authors' json, or a folder with km.json, ko.json, dv.json, vk.json, ns.json",
    ),
    ("car_studio", {"subset": "ko"}, "a folder with ko.json beside patch/ and mask/; found none"),
    ("car_studio", {"subset": "xy"}, "--subset 'xy': expected one of km, ko, dv, vk, ns"),
    ("car_studio/km.json", {"subset": "km"}, "is one file already; give its folder or no --subset"),
    ("car_studio", {"frames": "0-3"}, "--frames is for sources with photographs"),
    ("car_studio", {"segmenter": "onnx:x"}, "--segmenter is for sources with photographs"),
    ("car_studio/patch/empty.png", {}, "line 1 column 1: expected '{' to open the object with dataset_name"),
]


@pytest.mark.parametrize(("root", "changes", "message"), BAD_ROOTS)
def test_bad_settings_leave_nothing(tmp_path: Path, root: str, changes: dict[str, Any], message: str) -> None:
    write_files(tmp_path, lambda records: as_text({"dataset_name": "km", "instances": records}))
    with pytest.raises(InputError) as caught:
        build_files(tmp_path / root, tmp_path / "store", **changes)
    assert message in str(caught.value)
    assert not (tmp_path / "store").exists()


BAD_FILES = [
    (
        '{"dataset_name": "waymo", "instances": [{}]}',
        "expected dataset_name to be one of km, ko, dvm_car_studio, vk, ns",
    ),
    ('{"dataset_name": "km", "instances": []}', "expected a list of instances, found an empty one"),
    (
        '{"dataset_name": "km",\n "instances": [{}}',
        "line 2 column 18: expected ']' or ',' after an instance, found '}'",
    ),
]


@pytest.mark.parametrize(("text", "message"), BAD_FILES)
def test_bad_files_leave_nothing(tmp_path: Path, text: str, message: str) -> None:
    root = write_files(tmp_path, lambda _: text)
    with pytest.raises(InputError) as caught:
        build_files(root, tmp_path / "store")
    assert message in str(caught.value)
    assert str(root / "km.json") in str(caught.value)
    assert not (tmp_path / "store").exists()


def test_subset_is_for_the_authors_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--subset is for legacy-json; kitti-det has no subsets"):
        build(BuildConfig(source="kitti-det", root=tmp_path, out=tmp_path / "s", subset="ko"))


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file that says it has a billion pixels: refused by its header."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    pixels = chunk(b"IDAT", zlib.compress(bytes(60_000)))

    def text_of(records: list[dict[str, Any]]) -> str:
        records[1] |= {"patch": "patch/bomb.png", "w": 100_000, "h": 100_000}
        records[1] |= {"xmin": 0, "ymin": 0, "xmax": 59_999, "ymax": 59_999}
        return json.dumps({"dataset_name": "km", "instances": [records[1] | {"width": 1.6}]}, default=str)

    root = write_files(tmp_path, text_of)
    (root / "patch" / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + pixels)
    summary = build_files(root, tmp_path / "store")
    assert "at most 120,000,000" in summary.problems[0]
