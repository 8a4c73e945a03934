"""`carstudio dataset export --format kitti`: image_2/, label_2/ and calib/ in KITTI's official layout.

Each stored crop is a picture of its own with one car; its P2 has the principal point moved by the crop's corner. The
store's boxes are in the camera's frame already (offset applied), so the fourth columns are zero. `patches.csv` tells
which number is which patch, and mask_2/ holds the masks (0 background, 128 unknown, 255 car).
"""

import csv
import io
import math
from collections import Counter
from pathlib import Path

from carstudio.dataset.export_folder import ExportSummary, Which, export_folder, write_once
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.schema import JPEG_MAGIC
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.files import parse_json, write_text
from carstudio.geometry.transforms import yaw_from_rotation
from carstudio.images import decode_image, encode_png
from carstudio.progress import Report, silent

INDEX = "patches.csv"
MOST_TILT_RAD = math.radians(0.5)  # KITTI's boxes have a yaw alone; more tilt would move corners by more than 2 cm
TILTED = "3-D box is not upright: KITTI has a yaw alone"
_OCCLUSION_UNKNOWN = 3
_NO_BOX3D = "-1 -1 -1 -1000 -1000 -1000 -10"  # the devkit's numbers for "no 3-D box"


def export_kitti(store: PatchStore, out: Path, *, patches: Which = "kept", report: Report = silent) -> ExportSummary:
    """Write the store's patches below `out`, a new or empty folder, numbered from 000000 in store order."""
    wanted = frozenset(store.patch_ids(kept=patches == "kept"))
    left_out: Counter[str] = Counter()
    rows: list[tuple[str, str, str]] = []
    with export_folder(out):
        for done, record in enumerate((r for r in store.records() if r.patch_id in wanted), start=1):
            report("export", done, len(wanted), record.patch_id)
            if tilt_rad(record) > MOST_TILT_RAD:
                left_out[TILTED] += 1
                continue
            stem = f"{len(rows):06d}"
            _write_patch(out, stem, record)
            rows.append((stem, record.patch_id, record.instance_id))
        if not rows:
            reasons = "; ".join(f"{count} x {reason}" for reason, count in left_out.items())
            raise InputError(f"{store.path}: no patch can be exported ({reasons or 'none is kept'})")
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows([("frame", "patch_id", "instance_id"), *rows])
        write_text(out / INDEX, text.getvalue())
    return ExportSummary(out, {INDEX: len(rows)}, dict(left_out))


def _write_patch(out: Path, stem: str, record: PatchRecord) -> None:
    image = record.image
    if image.startswith(JPEG_MAGIC):  # KITTI's tools open .png only; the decoded pixels stay what they are
        image = encode_png(decode_image(image, name=f"image of patch {record.patch_id}"))
    write_once(out, f"image_2/{stem}.png", image)
    write_once(out, f"label_2/{stem}.txt", (label_line(record) + "\n").encode())
    write_once(out, f"calib/{stem}.txt", calibration_text(record).encode())
    if record.mask is not None:
        write_once(out, f"mask_2/{stem}.png", record.mask)


def tilt_rad(record: PatchRecord) -> float:
    """Angle between the box's up direction and the camera's y axis; 0 without a box."""
    box = record.box
    return 0.0 if box is None else math.acos(min(1.0, max(-1.0, float(box.rotation[1, 1]))))


def label_line(record: PatchRecord) -> str:
    """The 15 columns of an object label (16 where the 2-D box has a score), with six decimals."""
    x0, y0, x1, y1 = (
        value - corner for value, corner in zip(record.box2d, (record.crop_x0, record.crop_y0) * 2, strict=True)
    )
    extra = parse_json(record.extra, name=f"extra of patch {record.patch_id}")
    kind = str(extra.get("type", "Car")).split() if isinstance(extra, dict) else []
    columns = [
        kind[0] if len(kind) == 1 else "Car",
        f"{_truncation(record):.2f}",
        str(_OCCLUSION_UNKNOWN if record.occlusion is None else record.occlusion),
    ]
    alpha, box3d = _box_columns(record)
    columns += [f"{alpha:.6f}", *(f"{value:.6f}" for value in (x0, y0, x1, y1)), box3d]
    return " ".join(columns if record.score_2d is None else [*columns, f"{record.score_2d:.6f}"])


def _box_columns(record: PatchRecord) -> tuple[float, str]:
    """Alpha, and height width length, the bottom face's centre and rotation_y."""
    if record.box is None or record.box_center is None or record.box_size is None:
        return -10.0, _NO_BOX3D
    x, y, z = record.box_center
    length, height, width = record.box_size
    yaw = record.box_yaw if record.box_rotation is None else None
    yaw = float(yaw_from_rotation(record.box.rotation)) if yaw is None else yaw
    alpha = math.remainder(yaw - math.atan2(x, z), 2 * math.pi)
    return alpha, " ".join(f"{value:.6f}" for value in (height, width, length, x, y + height / 2, z, yaw))


def _truncation(record: PatchRecord) -> float:
    """0 to 1; the levels 1 and 2 of tracking labels are no shares: unknown, -1."""
    value = record.truncation
    is_share = value is not None and 0 <= value <= 1 and (value == 0 or record.source != "kitti-mot")
    return value if value is not None and is_share else -1.0


def calibration_text(record: PatchRecord) -> str:
    """A calibration file of the crop's camera. There is no lidar: Tr_velo_to_cam only turns the axes."""
    fx, fy, cx, cy = record.fx, record.fy, record.cx - record.crop_x0, record.cy - record.crop_y0
    projection = f"{fx:.9e} 0 {cx:.9e} 0 0 {fy:.9e} {cy:.9e} 0 0 0 1 0"
    lines = [f"P{camera}: {projection}" for camera in range(4)]
    lines += ["R0_rect: 1 0 0 0 1 0 0 0 1", "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0"]
    return "\n".join([*lines, "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0"]) + "\n"
