"""Named splits of the kept patches: which train, which test. Pure functions, no random state.

- `instance`: no car on both sides (zero-shot).
- `view`: the same cars, later views held out (multi-view, test-time optimisation).
- by yaw (`dataset split --by yaw`): the same cars, seen from sides that do not train.
- `yaw` of synthetic tracks: a drive trains, the car turned to the sides that the drive did not see is tested.
- `released-patch`: the released code's split by patch in store order; the same car stands on both sides.

Pictures that repeat each other (`duplicates.parquet`, where somebody has looked) are on one side of every split but the
released one.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from carstudio.dataset.duplicates import read_duplicates
from carstudio.errors import InputError

if TYPE_CHECKING:
    from carstudio.dataset.store import PatchStore

TRAIN_FRACTION = 0.9  # of the released split by patch
TEST_FRACTION = 0.1  # of the cars, to match it
VIEW_TRAIN_FRACTION = 2 / 3  # of a car's views in time order


@dataclass(frozen=True, slots=True)
class View:
    """What a split needs to know of a patch. `order`: position in time among the views of its instance."""

    patch_id: str
    instance_id: str
    order: int
    sequence_id: str | None = None
    duplicates: int | None = None  # the group of pictures that it repeats or that repeat it
    azimuth_rad: float | None = None  # from where around the car it was taken; None without a 3-D box


Parts = dict[str, str]  # patch_id -> "train" | "test"


def split_by_instance(views: Sequence[View], test_fraction: float = TEST_FRACTION, salt: str = "instance") -> Parts:
    """The ceil(fraction * n) instances with the smallest hash of their id are tested; one instance alone is trained on.

    Hashes instead of a generator: adding cars to a store moves few of the others to the other side. Cars that share a
    picture count as one.
    """
    return split_by_unit(views, [view.instance_id for view in views], test_fraction=test_fraction, salt=salt)


def split_by_unit(views: Sequence[View], units: Sequence[str], *, test_fraction: float, salt: str) -> Parts:
    """As `split_by_instance`, of whatever must not be parted: `units` names it for each view."""
    names = join_units(units, [view.duplicates for view in views])
    ranked = sorted(set(names), key=lambda name: _hash(f"{salt}:{name}"))
    num_test = math.ceil(test_fraction * len(ranked) - 1e-9) if len(ranked) > 1 else 0
    tested = set(ranked[:num_test])
    return {view.patch_id: "test" if name in tested else "train" for view, name in zip(views, names, strict=True)}


def join_units(units: Sequence[str], groups: Sequence[int | None]) -> list[str]:
    """Units that have a group in common become one, under the name that is first in the alphabet."""
    parent: dict[str | int, str | int] = {}

    def root(name: str | int) -> str | int:
        parent.setdefault(name, name)
        while parent[name] != name:
            parent[name] = name = parent[parent[name]]
        return name

    for unit, group in zip(units, groups, strict=True):
        if group is not None:
            parent[root(group)] = root(unit)
    first: dict[str | int, str] = {}
    for unit in units:
        first[root(unit)] = min(unit, first.get(root(unit), unit))
    return [first[root(unit)] for unit in units]


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def split_by_view(views: Sequence[View], train_fraction: float = VIEW_TRAIN_FRACTION) -> Parts:
    """Of each instance the first two thirds of its views in time order train, the rest test; a single view trains.

    A view to be tested that repeats a training view's picture trains instead.
    """
    parts: Parts = {}
    by_instance: dict[str, list[View]] = {}
    for view in views:
        by_instance.setdefault(view.instance_id, []).append(view)
    for members in by_instance.values():
        num_train = max(1, math.floor(train_fraction * len(members) + 1e-9))
        for rank, view in enumerate(sorted(members, key=lambda view: (view.order, view.patch_id))):
            parts[view.patch_id] = "train" if rank < num_train else "test"
    trained = {view.duplicates for view in views if parts[view.patch_id] == "train"} - {None}
    return parts | {view.patch_id: "train" for view in views if view.duplicates in trained}


def split_by_yaw(views: Sequence[View], train_fraction: float) -> Parts:
    """Of each instance the views taken from nearest to where its first view was taken from train, the rest test.

    So a model is asked for sides of the car that it was not shown. Views without a 3-D box train.
    """
    parts: Parts = {}
    by_instance: dict[str, list[View]] = {}
    for view in views:
        by_instance.setdefault(view.instance_id, []).append(view)
    for members in by_instance.values():
        members.sort(key=lambda view: (view.order, view.patch_id))
        turned = {view.patch_id: _turned(members, view) for view in members}
        num_train = max(1, math.floor(train_fraction * len(members) + 1e-9))
        ranked = sorted(members, key=lambda view: turned[view.patch_id])
        parts |= {view.patch_id: "train" if rank < num_train else "test" for rank, view in enumerate(ranked)}
    return parts


def _turned(members: Sequence[View], view: View) -> float:
    """How far around the car from its first view with a box, rad; 0 without a box."""
    first = next((member.azimuth_rad for member in members if member.azimuth_rad is not None), None)
    if first is None or view.azimuth_rad is None:
        return 0.0
    return abs(math.remainder(view.azimuth_rad - first, 2 * math.pi))


def split_by_drive(views: Sequence[View]) -> Parts:
    """Of each instance the views of a sequence train; of the others those from outside its range of azimuths test.

    Views from within the range, which would tell little, and views without a 3-D box stand in neither part.
    """
    drives: dict[str, list[float]] = {}
    for view in views:
        if view.sequence_id is not None and view.azimuth_rad is not None:
            drives.setdefault(view.instance_id, []).append(view.azimuth_rad)
    parts: Parts = {}
    for view in views:
        if view.azimuth_rad is None or view.instance_id not in drives:
            continue
        if view.sequence_id is not None:
            parts[view.patch_id] = "train"
        elif not _is_between(view.azimuth_rad, drives[view.instance_id]):
            parts[view.patch_id] = "test"
    return parts


def _is_between(azimuth_rad: float, azimuths_rad: Sequence[float]) -> bool:
    """Whether a direction lies in the range of others, rad; they go less than half way around."""
    low, high = 0.0, 0.0
    for other in azimuths_rad:
        turn = math.remainder(other - azimuths_rad[0], 2 * math.pi)
        low, high = min(low, turn), max(high, turn)
    return low <= math.remainder(azimuth_rad - azimuths_rad[0], 2 * math.pi) <= high


SplitBy = Literal["instance", "view", "sequence", "patch", "yaw"]


def make_split(views: Sequence[View], *, by: SplitBy, test_share: float = TEST_FRACTION, seed: int = 0) -> Parts:
    """A split of one's own: `test_share` of the cars, sequences or patches, or of each car's views (the last in time).

    Seed 0 by instance is the standard split `instance`. By view or yaw there is nothing to draw: the seed changes
    nothing.
    """
    if not 0 < test_share < 1:
        raise InputError(f"--test-share must be above 0 and below 1, found {test_share}")
    if by == "view":
        return split_by_view(views, 1 - test_share)
    if by == "yaw":
        return split_by_yaw(views, 1 - test_share)
    units = [{"instance": view.instance_id, "patch": view.patch_id}.get(by, view.sequence_id) for view in views]
    without = [view.patch_id for view, unit in zip(views, units, strict=True) if unit is None]
    if without:
        raise InputError(
            f"{len(without)} kept patches belong to no sequence, {without[0]} among them; split by instance instead"
        )
    salt = by if seed == 0 else f"{by}-{seed}"
    return split_by_unit(views, [str(unit) for unit in units], test_fraction=test_share, salt=salt)


def split_as_released(views: Sequence[View]) -> Parts:
    """ceil(0.9 N) train indices spread evenly over the patches in store order, as the released loader takes them."""
    num_views = len(views)
    num_train = math.ceil(TRAIN_FRACTION * num_views)
    train = set(np.linspace(0, num_views - 1, num_train).astype(int).tolist())
    return {view.patch_id: "train" if index in train else "test" for index, view in enumerate(views)}


def write_splits(store: "PatchStore") -> dict[str, dict[str, int]]:
    """Write the three splits over the store's kept patches; returns name -> {"train": n, "test": n}."""
    views = kept_views(store)
    counts = {}
    for name, split in (
        ("instance", split_by_instance),
        ("view", split_by_view),
        ("released-patch", split_as_released),
    ):
        parts = split(views)
        store.write_split(name, parts)
        counts[name] = count_parts(parts)
    return counts


def kept_views(store: "PatchStore") -> list[View]:
    """The kept patches in store order; time order is the frame index where there is one, else the store's."""
    kept = set(store.patch_ids())
    found = read_duplicates(store)
    groups = {} if found is None else found.groups()
    table = store.table(["patch_id", "instance_id", "frame_index", "sequence_id"])
    rows = zip(*(table[name].to_pylist() for name in table.column_names), strict=True)
    return [
        View(patch_id, instance_id, rank if frame_index is None else frame_index, sequence_id, groups.get(patch_id))
        for rank, (patch_id, instance_id, frame_index, sequence_id) in enumerate(rows)
        if patch_id in kept
    ]


def seen_from(views: Sequence[View], azimuth_deg: Mapping[str, float]) -> list[View]:
    """The views with their azimuths (by patch id, NaN where unknown, as `measure` gives them)."""
    degrees = [azimuth_deg.get(view.patch_id, math.nan) for view in views]
    return [
        replace(view, azimuth_rad=None if math.isnan(angle) else math.radians(angle))
        for view, angle in zip(views, degrees, strict=True)
    ]


def count_parts(parts: Mapping[str, str]) -> dict[str, int]:
    """Patches per side."""
    values = list(parts.values())
    return {"train": values.count("train"), "test": values.count("test")}
