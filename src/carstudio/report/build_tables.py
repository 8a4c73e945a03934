"""Tables about a store: reasons, the paper's dataset table, cameras and what their roughness costs, licences."""

from collections import Counter

import numpy as np
from jaxtyping import Bool

from carstudio.dataset.measured import Measured, reasons_in_order
from carstudio.evaluation.tables import Cell, Table

ROUGH_CAMERAS = ("exif", "assumed", "paper")  # kinds of `camera_source` that are no calibration
SIDE_DEG = (45.0, 135.0)  # azimuths of a side view, either side

Flags = Bool[np.ndarray, " patch"]


def reason_table(measured: Measured) -> Table:
    """Patches per reason, with what the filter asked for."""
    rows = [
        (
            Cell(reason),
            Cell(f"{count:,}"),
            Cell(f"{100 * count / max(1, len(measured)):.1f} %"),
            Cell(measured.thresholds[reason].text if reason in measured.thresholds else "–"),
        )
        for reason, count in reasons_in_order(measured)
    ]
    notes = ("The reason is the first filter that a patch failed; it may have failed others too.",)
    return Table("Verdicts", ("Reason", "Patches", "Share", "Asked for"), tuple(rows), notes)


def dataset_tables(measured: Measured) -> list[Table]:
    """The measurable columns of the paper's table of CarPatch3D's sources, and mean sizes."""
    sources = sorted(set(measured.source.tolist()))
    groups = {source: measured.source == source for source in sources}
    if len(sources) > 1:
        groups["all"] = np.ones(len(measured), bool)
    heads = ("Source", "Intrinsics", "Orientation", "Cars with one view", "with several", "Patches", "Cars")
    notes = (
        "The columns of the paper's dataset table that can be measured, of kept patches. Orientation: share seen from "
        "the side, at an azimuth of 45° to 135° on either side.",
    )
    rows = tuple(_dataset_row(name, measured, chosen) for name, chosen in groups.items())
    sizes = tuple(_size_row(name, measured, chosen) for name, chosen in groups.items())
    size_heads = ("Source", "Candidates", "Kept", "Mean patch (px)", "Mean box, length x height x width (m)")
    return [Table("CarPatch3D by source", heads, rows, notes), Table("Sizes of kept patches", size_heads, sizes)]


def _dataset_row(name: str, measured: Measured, chosen: Flags) -> tuple[Cell, ...]:
    kept = chosen & measured.is_kept
    views = Counter(measured.instance_id[kept].tolist()).values()
    azimuth = np.abs(measured.values["azimuth_deg"][kept])
    known = np.isfinite(azimuth)
    sides = ((azimuth >= SIDE_DEG[0]) & (azimuth <= SIDE_DEG[1]))[known]
    cells = [
        name,
        "rough" if any(map(is_rough, set(measured.camera_source[chosen].tolist()))) else "known",
        f"{100 * sides.mean():.0f} % side" if known.any() else "–",
        f"{sum(count == 1 for count in views):,}",
        f"{sum(count > 1 for count in views):,}",
        f"{int(kept.sum()):,}",
        f"{len(views):,}",
    ]
    return tuple(map(Cell, cells))


def _size_row(name: str, measured: Measured, chosen: Flags) -> tuple[Cell, ...]:
    kept = chosen & measured.is_kept
    patch = _means(measured, kept, ("crop_width", "crop_height"), 0)
    box = _means(measured, kept, ("length_m", "height_m", "width_m"), 2)
    return tuple(map(Cell, [name, f"{int(chosen.sum()):,}", f"{int(kept.sum()):,}", patch, box]))


def _means(measured: Measured, chosen: Flags, names: tuple[str, ...], digits: int) -> str:
    columns = [measured.values[name][chosen] for name in names]
    if not all(np.isfinite(column).any() for column in columns):
        return "–"
    return " x ".join(f"{np.nanmean(column):.{digits}f}" for column in columns)


def is_rough(camera_source: str) -> bool:
    """Whether intrinsics are a guess from the photo's EXIF or its size, and no calibration."""
    return camera_kind(camera_source) in ROUGH_CAMERAS


def camera_kind(camera_source: str) -> str:
    """What stands before the colon: `calib:P2` is `calib`."""
    return camera_source.split(":")[0]


def camera_table(measured: Measured) -> Table:
    """How often each origin of intrinsics occurs, and how well 2-D and 3-D boxes agree under it."""
    rows = []
    for source, count in sorted(Counter(measured.camera_source.tolist()).items()):
        chosen = measured.camera_source == source
        iou = measured.values["box_iou"][chosen]
        iou = iou[np.isfinite(iou)]
        low, middle = (f"{np.percentile(iou, q):.3f}" if len(iou) else "–" for q in (5, 50))
        cells = [source, f"{count:,}", f"{int((chosen & measured.is_kept).sum()):,}", middle, low]
        rows.append(tuple(map(Cell, [*cells, "yes" if is_rough(source) else "no"])))
    heads = ("Camera", "Patches", "Kept", "box_iou, median", "5th percentile", "Rough")
    return Table("Where the intrinsics come from", heads, tuple(rows))


def camera_sentence(measured: Measured) -> str:
    """What a rough camera means for this store, in plain words."""
    rough = np.array([is_rough(source) for source in measured.camera_source.tolist()], bool)
    if not rough.any():
        return "All intrinsics come from a calibration or are exact."
    sentence = (
        f"The camera of {int(rough.sum()):,} of {len(measured):,} patches is rough: its focal length was read from the "
        "photo's EXIF or assumed from the photo's size, not calibrated. The depth of a 3-D box is then wrong by about "
        "the same share as the focal length."
    )
    iou = measured.values["box_iou"][rough]
    iou = iou[np.isfinite(iou)]
    if not len(iou):
        return f"{sentence} No patch among them has a 3-D box, so nothing tells how wrong."
    limit = measured.thresholds.get("box_iou")
    told = "" if limit is None else f", and {100 * (iou < limit.values[0]).mean():.0f} % miss the filter's threshold"
    return (
        f"{sentence} The evidence is the overlap of 2-D box and re-projected 3-D box: its median is "
        f"{np.median(iou):.3f}{told}."
    )


def licence_table(measured: Measured) -> Table:
    """Sources and the licences of their photographs."""
    pairs = Counter(zip(measured.source.tolist(), measured.licence.tolist(), strict=True))
    rows = tuple(
        (Cell(source), Cell(licence), Cell(f"{count:,}")) for (source, licence), count in sorted(pairs.items())
    )
    return Table("Sources and licences", ("Source", "Licence of the photographs", "Patches"), rows)
