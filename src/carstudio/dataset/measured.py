"""Everything that was measured about a store's patches, as columns of numbers: for reports and cards.

Only light columns and verdicts are read, as Arrow buffers: half a million patches take seconds. NaN is "unknown".
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from jaxtyping import Bool, Float

from carstudio.dataset.store import PatchStore
from carstudio.dataset.verdicts import KEPT
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import viewing_angles
from carstudio.geometry.transforms import rotation_from_quaternion, rotation_y

_TEXTS = ("patch_id", "instance_id", "source", "licence", "camera_source")
_NUMBERS = ("score_2d", "score_mask", "score_3d", "mask_ratio", "box_iou", "truncation", "occlusion", "box_yaw")
_SIZES = ("crop_width", "crop_height")
_LISTS = ("box2d", "box_center", "box_size", "box_rotation")
UNJUDGED = "unjudged"  # the reason of a patch without a verdict, which counts as kept

Column = Float[np.ndarray, " patch"]


@dataclass(frozen=True)
class Threshold:
    """What a filter asked for: the thresholds in the store's verdicts (one, but after a merge), and where they bite."""

    values: tuple[float, ...]
    is_least: bool | None  # rejected are values below it (True) or above it (False); None: it rejected nothing

    @property
    def text(self) -> str:
        """The thresholds and what they ask for, such as "at least 64"."""
        sense = {True: "at least ", False: "at most ", None: ""}[self.is_least]
        return sense + " or ".join(f"{value:g}" for value in self.values)


@dataclass(frozen=True)
class Measured:
    """One entry per candidate in store order; `values` by name, with the filters' names where they measure the same."""

    patch_id: np.ndarray
    instance_id: np.ndarray
    source: np.ndarray
    licence: np.ndarray
    camera_source: np.ndarray
    reason: np.ndarray
    is_kept: Bool[np.ndarray, " patch"]
    has_mask: Bool[np.ndarray, " patch"]
    values: Mapping[str, Column]
    thresholds: Mapping[str, Threshold] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.patch_id)

    @property
    def has_box(self) -> Bool[np.ndarray, " patch"]:
        """Which have a 3-D box."""
        return np.isfinite(self.values["depth_m"])


def measure(store: PatchStore) -> Measured:
    """Read the light columns and the verdicts of a store."""
    table = store.table([*_TEXTS, *_NUMBERS, *_SIZES, *_LISTS])
    texts = {name: table[name].to_numpy() for name in _TEXTS}
    reason, is_kept, checked, thresholds = _judgements(store, table["patch_id"])
    return Measured(
        **texts,
        reason=reason,
        is_kept=is_kept,
        has_mask=pc.is_valid(store.picture_names("mask")).to_numpy(),
        values=checked | _columns(table),
        thresholds=thresholds,
    )


def azimuths_deg(measured: Measured) -> dict[str, float]:
    """patch_id -> from where around its car it was taken; NaN without a 3-D box."""
    return dict(zip(measured.patch_id.tolist(), measured.values["azimuth_deg"].tolist(), strict=True))


def _columns(table: pa.Table) -> dict[str, Column]:
    values = {name: _numbers(table[name]) for name in (*_NUMBERS, *_SIZES)}
    box2d, center, size = (
        _lists(table[name], width) for name, width in (("box2d", 4), ("box_center", 3), ("box_size", 3))
    )
    values |= {"width_px": box2d[:, 2] - box2d[:, 0], "height_px": box2d[:, 3] - box2d[:, 1], "depth_m": center[:, 2]}
    values |= {f"{name}_m": size[:, axis] for axis, name in enumerate(("length", "height", "width"))}
    box = Box3D(torch.from_numpy(center), torch.from_numpy(size), _rotations(table, values["box_yaw"]))
    azimuth, elevation = (np.degrees(angle.numpy()) for angle in viewing_angles(box))
    values |= {"azimuth_deg": azimuth, "elevation_deg": elevation, "yaw_deg": np.degrees(values.pop("box_yaw"))}
    return values


def _rotations(table: pa.Table, yaw_rad: Column) -> torch.Tensor:
    rotation = rotation_y(torch.from_numpy(yaw_rad))
    quaternion = torch.from_numpy(_lists(table["box_rotation"], 4))
    is_full = torch.isfinite(quaternion[:, 0])
    rotation[is_full] = rotation_from_quaternion(quaternion[is_full])
    return rotation


def _numbers(column: pa.ChunkedArray) -> Column:
    return np.array(pc.cast(column, pa.float64()).fill_null(float("nan")).to_numpy(), np.float64)


def _lists(column: pa.ChunkedArray, width: int) -> Float[np.ndarray, "patch _width"]:
    """Rows of NaN where a list is missing; lists of another length count as missing too."""
    is_whole = pc.equal(pc.list_value_length(column), width).fill_null(False).to_numpy()
    rows = np.full((len(column), width), np.nan)
    rows[is_whole] = _numbers(pc.list_flatten(column.filter(pa.array(is_whole)))).reshape(-1, width)
    return rows


def _judgements(
    store: PatchStore, patch_ids: pa.ChunkedArray
) -> tuple[np.ndarray, np.ndarray, dict[str, Column], dict[str, Threshold]]:
    """Reason, whether kept, and per filter the values it saw and its threshold; in the order of `patch_ids`."""
    table = store.verdict_columns("patch_id", "is_kept", "reason", "checks").combine_chunks()
    places = pc.index_in(patch_ids, value_set=pa.array(table["patch_id"].to_pylist(), pa.string()))
    reason = pc.take(table["reason"], places).fill_null(UNJUDGED).to_numpy()
    is_kept = np.asarray(pc.take(table["is_kept"], places).fill_null(True).to_numpy(), bool)
    rank = np.full(len(table), -1)  # of a verdict's patch in the store
    at = _numbers(places)
    rank[at[np.isfinite(at)].astype(int)] = np.flatnonzero(np.isfinite(at))
    checks = pc.list_flatten(table["checks"])
    row = rank[pc.list_parent_indices(table["checks"]).to_numpy()] if len(table) else np.zeros(0, int)
    name, value, threshold, is_passed = (
        pc.struct_field(checks, part) for part in ("filter", "value", "threshold", "is_passed")
    )
    values, thresholds = {}, {}
    for one in pc.unique(name).to_pylist():
        chosen = pc.equal(name, one)
        seen, asked = _numbers(value.filter(chosen)), _numbers(threshold.filter(chosen))
        values[one] = np.full(len(patch_ids), np.nan)
        values[one][row[np.asarray(chosen.to_numpy(), bool)]] = seen
        if np.isfinite(asked).any():
            failed = ~np.asarray(is_passed.filter(chosen).to_numpy(), bool) & np.isfinite(seen)
            is_least = bool((seen <= asked)[failed].mean() > 0.5) if failed.any() else None
            thresholds[one] = Threshold(tuple(np.unique(asked[np.isfinite(asked)]).tolist()), is_least)
    return reason, is_kept, values, thresholds


def reasons_in_order(measured: Measured) -> list[tuple[str, int]]:
    """(reason, patches): kept first, then the most frequent."""
    names, counts = np.unique(measured.reason, return_counts=True)
    return sorted(
        zip(names.tolist(), counts.tolist(), strict=True), key=lambda item: (item[0] != KEPT, -item[1], item[0])
    )
