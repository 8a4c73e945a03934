"""Named splits of the kept patches: which train, which test. Pure functions, no random state.

- `instance`: no car on both sides (zero-shot).
- `view`: the same cars, later views held out (multi-view, test-time optimisation).
- `released-patch`: the released code's split by patch in store order; the same car stands on both sides.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

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


Parts = dict[str, str]  # patch_id -> "train" | "test"


def split_by_instance(views: Sequence[View], test_fraction: float = TEST_FRACTION, salt: str = "instance") -> Parts:
    """The ceil(fraction * n) instances with the smallest hash of their id are tested; one instance alone is trained on.

    Hashes instead of a generator: adding cars to a store moves few of the others to the other side.
    """
    instances = sorted({view.instance_id for view in views}, key=lambda name: _hash(f"{salt}:{name}"))
    num_test = math.ceil(test_fraction * len(instances) - 1e-9) if len(instances) > 1 else 0
    tested = set(instances[:num_test])
    return {view.patch_id: "test" if view.instance_id in tested else "train" for view in views}


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def split_by_view(views: Sequence[View]) -> Parts:
    """Of each instance the first two thirds of its views in time order train, the rest test; a single view trains."""
    parts: Parts = {}
    by_instance: dict[str, list[View]] = {}
    for view in views:
        by_instance.setdefault(view.instance_id, []).append(view)
    for members in by_instance.values():
        num_train = max(1, math.floor(VIEW_TRAIN_FRACTION * len(members) + 1e-9))
        for rank, view in enumerate(sorted(members, key=lambda view: (view.order, view.patch_id))):
            parts[view.patch_id] = "train" if rank < num_train else "test"
    return parts


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
    table = store.table(["patch_id", "instance_id", "frame_index"])
    rows = zip(*(table[name].to_pylist() for name in table.column_names), strict=True)
    return [
        View(patch_id, instance_id, rank if frame_index is None else frame_index)
        for rank, (patch_id, instance_id, frame_index) in enumerate(rows)
        if patch_id in kept
    ]


def count_parts(parts: Mapping[str, str]) -> dict[str, int]:
    """Patches per side."""
    values = list(parts.values())
    return {"train": values.count("train"), "test": values.count("test")}
