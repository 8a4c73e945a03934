"""Verdicts: which patches are kept, why not, and what every filter measured.

They lie beside the data, keyed by patch_id, so that filtering again never touches a picture.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from carstudio.errors import InputError

KEPT = "kept"  # the reason of a patch that passed everything


@dataclass(frozen=True)
class Check:
    """One filter's measurement; None where a value is unknown or a filter has no numeric threshold."""

    filter: str
    value: float | None
    threshold: float | None
    is_passed: bool


@dataclass(frozen=True)
class Verdict:
    """Judgement of one patch: `reason` is "kept" or the first filter that failed, `failed` all that did."""

    patch_id: str
    is_kept: bool
    reason: str = KEPT
    failed: tuple[str, ...] = ()
    checks: tuple[Check, ...] = ()


_CHECK = pa.struct(
    [("filter", pa.string()), ("value", pa.float64()), ("threshold", pa.float64()), ("is_passed", pa.bool_())]
)
VERDICT_SCHEMA = pa.schema(
    [
        pa.field("patch_id", pa.string(), nullable=False),
        pa.field("is_kept", pa.bool_(), nullable=False),
        pa.field("reason", pa.string(), nullable=False),
        pa.field("failed", pa.list_(pa.string()), nullable=False),
        pa.field("checks", pa.list_(_CHECK), nullable=False),
    ]
)


def table_from_verdicts(verdicts: Iterable[Verdict]) -> pa.Table:
    """Rows of `verdicts.parquet` in the order given."""
    rows = [
        {
            "patch_id": verdict.patch_id,
            "is_kept": verdict.is_kept,
            "reason": verdict.reason,
            "failed": list(verdict.failed),
            "checks": [vars(check) for check in verdict.checks],
        }
        for verdict in verdicts
    ]
    return pa.Table.from_pylist(rows, schema=VERDICT_SCHEMA)


def verdicts_from_table(table: pa.Table) -> list[Verdict]:
    """Inverse of `table_from_verdicts`; `InputError` names the patch whose checks lack something."""
    return [
        Verdict(
            patch_id=row["patch_id"],
            is_kept=row["is_kept"],
            reason=row["reason"],
            failed=tuple(row["failed"]),
            checks=tuple(Check(**check) for check in row["checks"]),
        )
        for row in map(_whole, table.to_pylist())
    ]


def _whole(row: dict[str, Any]) -> dict[str, Any]:
    is_whole = all(check and check["filter"] is not None and check["is_passed"] is not None for check in row["checks"])
    if not is_whole or None in row["failed"]:
        raise InputError(
            f"verdicts.parquet: patch {row['patch_id']!r}: every check must have a filter and its outcome, found "
            f"{str(row['checks'])[:80]}; judge the store again with `carstudio dataset refilter`"
        )
    return row
