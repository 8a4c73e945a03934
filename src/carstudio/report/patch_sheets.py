"""Contact sheets of stored patches: the crop with 2-D box, wireframe of the 3-D box and mask, and why it was rejected.

A few patches per reason are shown, evenly spread over the store, always the same ones.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from carstudio.dataset.measured import Measured
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.store import PatchStore
from carstudio.dataset.verdicts import KEPT
from carstudio.errors import InputError
from carstudio.progress import Report, silent
from carstudio.report.overlays import draw_box2d, draw_box3d, draw_mask
from carstudio.report.sheets import TILE_GROUND, Pixels, Tile, contact_sheet

MARGIN = 0.15  # of the crop's longer side, around it, so that boxes that leave the crop are seen
ENLARGED_PX = 480  # longer side of a crop before lines are drawn, so that they come out thin
TILE_PX = (208, 148)
COLUMNS = 4


def spread(count: int, most: int) -> list[int]:
    """At most `most` of `count` indices, evenly spread, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return np.linspace(0, count - 1, most).round().astype(int).tolist() if most > 1 else [0][:most]


def overlay(record: PatchRecord) -> Pixels:
    """A patch enlarged, with mask, 2-D box and 3-D box; a margin in grey shows what leaves the crop."""
    patch = record.decode()
    height, width = patch.image.shape[:2]
    if patch.mask.shape != (height, width) or (width, height) != (record.crop_width, record.crop_height):
        raise InputError(f"image, mask and crop of patch {record.patch_id} differ in size; run `dataset verify`")
    picture = patch.image if record.mask is None else draw_mask(patch.image, patch.mask, strength=0.25)
    scale = max(ENLARGED_PX / max(height, width), 1e-3)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    margin = round(MARGIN * max(size))
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    enlarged = cv2.resize(picture, size, interpolation=method)
    framed = cv2.copyMakeBorder(enlarged, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=TILE_GROUND)
    camera = patch.camera.resize(*size).crop(-margin, -margin, framed.shape[1], framed.shape[0])
    if patch.box is not None:
        framed = draw_box3d(framed, patch.box, camera, thickness_px=2)
    zoom = np.array([size[0] / width, size[1] / height] * 2)
    corner = np.array([record.crop_x0, record.crop_y0] * 2)
    box2d = (np.array(record.box2d) - corner) * zoom + margin
    x0, y0, x1, y1 = map(float, box2d)
    return draw_box2d(framed, (x0, y0, x1, y1), thickness_px=2)


def caption(record: PatchRecord, measured: Measured, index: int) -> str:
    """Patch id; the value that failed, with what was asked for; what the patch lacks."""
    reason = str(measured.reason[index])
    lines = [record.patch_id]
    if reason == KEPT:
        shown = [("IoU", "box_iou"), ("mask", "mask_ratio")]
        values = [(label, measured.values[name][index]) for label, name in shown]
        lines.append(", ".join(f"{label} {value:.2f}" for label, value in values if np.isfinite(value)))
    else:
        value = measured.values.get(reason, np.full(len(measured), np.nan))[index]
        limit = measured.thresholds.get(reason)
        has_value = np.isfinite(value) and limit is not None
        asked = " or ".join(f"{value:g}" for value in limit.values) if limit is not None else ""
        lines.append(f"{reason} {value:.3g}, limit {asked}" if has_value else reason)
    lacking = [name for name, lacks in (("no mask", record.mask is None), ("no 3-D box", record.box is None)) if lacks]
    return "\n".join(line for line in (*lines, ", ".join(lacking)) if line)


def reason_sheet(
    store: PatchStore, measured: Measured, reason: str, *, most: int, report: Report = silent
) -> Pixels | None:
    """Up to `most` patches of one reason; None where there are none."""
    indices = np.flatnonzero(measured.reason == reason)
    return patches_sheet(store, measured, [int(indices[i]) for i in spread(len(indices), most)], report=report)


def patches_sheet(
    store: PatchStore, measured: Measured, indices: Sequence[int], *, report: Report = silent
) -> Pixels | None:
    """The patches at these places of the store; None where there are none."""
    tiles = []
    for done, index in enumerate(indices, start=1):
        patch_id = str(measured.patch_id[index])
        report("contact sheets", done, len(indices), patch_id)
        try:
            record = store.record(patch_id)
            tiles.append(Tile(overlay(record), caption(record, measured, index)))
        except InputError as error:  # a damaged picture is a finding of the report, not its end
            tiles.append(Tile(np.full((TILE_PX[1], TILE_PX[0], 3), TILE_GROUND, np.uint8), f"{patch_id}\n{error}"))
    return contact_sheet(tiles, columns=min(COLUMNS, len(tiles)), tile_px=TILE_PX) if tiles else None
