"""Made-up files in the authors' layout, one json per subset, with what their real ones have and more."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from oracles.released_formulas import envelope

KITTI = {"fl_x": 721.5377, "fl_y": 721.5377, "cx": 609.5593, "cy": 172.854}
KITTI_T = {"cam_tx": 44.85728, "cam_ty": 0.2163791, "cam_tz": 0.002745884}
DVM = {"fl_x": 721.5377, "fl_y": 721.5377, "cx": 150, "cy": 150}  # whole numbers stay whole
NO_T = {"cam_tx": 0, "cam_ty": 0, "cam_tz": 0}
DISTORTION = {"k1": 0, "k2": 0.0, "k3": -0.0, "p1": 1e-17, "p2": 0.1234567890123456789}
DATASET_NAMES = {"km": "km", "ko": "ko", "dv": "dvm_car_studio", "vk": "vk", "ns": "ns"}
STEMS = {
    "km": ["km_0100097004", "km_0100098004", "km_0100097011", "km_2000003004"],
    "vk": ["vk_1800000007", "vk_1800001007", "vk_0200001007"],
    "ko": ["ko_000000300000", "ko_000000300001", "ko_000748012345"],
    "ns": ["ns_0120000300001", "ns_0120000400001", "ns_8490000300002"],
    "dv": ["dv_0000000000017", "dv_0000001000017", "dv_0000002123456"],
}


@dataclass(frozen=True)
class Exactly:
    """A number written in the file with exactly this text."""

    text: str


def make_record(subset: str, stem: str, index: int) -> dict[str, Any]:
    """A car whose 2-D box is its 3-D box's envelope."""
    camera = DVM | NO_T if subset == "dv" else KITTI | KITTI_T
    place = {"obj_x": 0.1 + index / 3, "obj_y": 0.8 if subset == "dv" else 1.65, "obj_z": 30.0 + 7 / 3 * index}
    record: dict[str, Any] = {
        "patch": f"patch/{stem}_patch.png",
        "mask": f"mask/{stem}_mask.png",
        "image_file": f"nowhere/{stem[:8]}.png",  # need not exist
        **camera,
        "height": 1.526, "width": 1.63, "length": 3.8800001144409180, **place, "yaw": -1.57 + index / 7,
    }  # fmt: skip
    record |= dict(zip(("xmin", "ymin", "xmax", "ymax"), envelope(record), strict=True))
    return record


def make_records(subset: str) -> list[dict[str, Any]]:
    records = [make_record(subset, stem, index) for index, stem in enumerate(STEMS[subset])]
    for record in records:
        if subset != "ko":  # one writer leaves the photograph's size out
            record |= {"w": 300, "h": 300} if subset == "dv" else {"w": 1242, "h": 375}
        if subset in ("km", "vk"):
            record |= DISTORTION
    records[0]["yaw"] = Exactly("-0.0")
    records[1]["colour 色"] = {"name": "grün", "rgb": [1, 2.50, None], "n": Exactly("1.50e+2")}  # unknown key
    records[1]["width"] = Exactly("1.6299999999999999112")  # more digits than a float has
    records[2]["image_file"] = "Straße/\\u8eca \U0001f697.png"
    return records


def as_text(value: Any, **style: Any) -> str:
    """JSON, with `Exactly` numbers as they are."""
    text = json.dumps(value, default=lambda number: f"@@{number.text}@@", **style)
    return text.replace('"@@', "").replace('@@"', "")


def as_numbers(record: dict[str, Any]) -> dict[str, Any]:
    """The record as a JSON reader sees it."""
    value: dict[str, Any] = json.loads(as_text(record))
    return value


def write_pictures(folder: Path, subset: str, records: list[dict[str, Any]]) -> None:
    rng = np.random.default_rng(len(subset))
    for number, record in enumerate(map(as_numbers, records)):
        width = int(record["xmax"]) - int(record["xmin"]) + 1
        height = int(record["ymax"]) - int(record["ymin"]) + 1
        mask = np.zeros((height, width), np.uint8)
        mask[height // 8 : -height // 8, width // 10 : -width // 10] = 255
        if subset == "ns":  # three channels, and values other than 255: any that is not zero is car
            mask = np.stack([mask // 255 * np.uint8(number), mask * 0, mask // 255 * 3], axis=-1)
        if subset == "vk":
            mask = mask // 255 * np.uint8(number + 1)
        for path, pixels in (
            (record["patch"], rng.integers(0, 256, (height, width, 3), dtype=np.uint8)),
            (record["mask"], mask),
        ):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(pixels).save(
                folder / path, compress_level=number % 10
            )  # bytes that no encoder of ours gives


def write_subset(folder: Path, subset: str, records: list[dict[str, Any]] | None = None) -> Path:
    """`folder/SUBSET.json` with its patches and masks; returns the json."""
    records = make_records(subset) if records is None else records
    write_pictures(folder, subset, records)
    value: dict[str, Any] = {"dataset_name": DATASET_NAMES[subset], "instances": records}
    style: dict[str, Any] = {}
    if subset == "ko":
        style = {"indent": 4}
    if subset == "dv":
        value = {"instances": records, "made": {"by": "hand", "n": 1}, "dataset_name": "dvm_car_studio"}
        style = {"separators": (",", ":"), "ensure_ascii": False}
    path = folder / f"{subset}.json"
    path.write_text(as_text(value, **style) + ("\r\n" if subset == "vk" else ""), encoding="utf-8", newline="")
    return path


def write_all(folder: Path) -> Path:
    for subset in DATASET_NAMES:
        write_subset(folder, subset)
    return folder
