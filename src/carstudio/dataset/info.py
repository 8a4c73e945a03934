"""What `carstudio dataset info` counts; pictures are not read."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from carstudio.dataset.summary import sort_reasons

if TYPE_CHECKING:
    from carstudio.dataset.store import PatchStore

_COLUMNS = ["patch_id", "instance_id", "source", "licence", "camera_source", "box_center", "crop_height"]


def store_info(store: "PatchStore") -> dict[str, Any]:
    """Counts: patches, instances, per source, licence, camera and verdict reason, splits, sizes."""
    table = store.table(_COLUMNS)
    verdicts = store.verdict_columns("patch_id", "is_kept", "reason")
    reasons = _counts(verdicts["reason"])
    rejected = verdicts.filter(pc.invert(verdicts["is_kept"]))["patch_id"].combine_chunks()
    kept = table.filter(pc.invert(pc.is_in(table["patch_id"], rejected)))
    heights: Counter[int] = Counter()
    for height, count in _counts(table["crop_height"]).items():
        heights[32 * (height // 32)] += count
    return {
        "path": str(store.path),
        "format_version": store.manifest.format_version,
        "is_finished": store.manifest.is_finished,
        "data_sha256": store.data_sha256,
        "patches": len(store),
        "kept": len(kept),
        "instances": pc.count_distinct(table["instance_id"]).as_py(),
        "kept_instances": pc.count_distinct(kept["instance_id"]).as_py(),
        "with_box3d": _present(table["box_center"]),
        "with_mask": _present(store.picture_names("mask")),
        "sources": dict(sorted(_counts(table["source"]).items())),
        "licences": dict(sorted(_counts(table["licence"]).items())),
        "cameras": dict(sorted(_counts(table["camera_source"]).items())),
        "reasons": sort_reasons(reasons),
        "unjudged": len(store) - sum(reasons.values()),
        "splits": {name: dict(sorted(Counter(store.split(name).values()).items())) for name in store.split_names()},
        "crop_height_px": {f"{low}-{low + 31}": heights[low] for low in sorted(heights)},
    }


def _present(column: pa.ChunkedArray) -> dict[str, int | float]:
    """How many values there are, and which share of the patches that is."""
    count = len(column) - column.null_count
    return {"patches": count, "share": round(count / max(1, len(column)), 4)}


def _counts(column: pa.ChunkedArray) -> dict[Any, int]:
    """How often each value occurs."""
    return {row["values"]: row["counts"] for row in pc.value_counts(column).to_pylist()}
