"""Result files: one scored image per line of JSON (`ROWS.jsonl`), and `ROWS.header.json` beside it.

The header says how the rows came about and why a metric is null throughout (say, LPIPS not installed); it is a file of
its own so that pandas, DuckDB and `jq` read the rows as they are.
"""

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from carstudio import __version__
from carstudio.errors import InputError, shortened
from carstudio.files import parse_json, read_json, write_json, write_text

METRICS = ("psnr", "psnr_mask", "ssim", "ssim_mask", "lpips", "mask_iou")
METRIC_DEFINITION = (
    "Mean over images, each on its box crop with the truth on black; (car) = the same over car pixels only. "
    "Unknown pixels take part in no metric."
)


@dataclass(frozen=True, kw_only=True)
class ResultRow:
    """Scores of one image. A metric is None where it could not be measured."""

    method: str
    protocol: str  # input-view or novel-view
    split: str
    instance_id: str
    patch_id: str  # the image scored
    input_patch_id: str  # the image the model saw
    psnr: float | None  # dB
    psnr_mask: float | None  # dB, car pixels only
    ssim: float | None
    ssim_mask: float | None  # car pixels only
    lpips: float | None
    mask_iou: float | None
    seed: int
    steps: int  # training steps of the checkpoint
    data_sha256: str
    checkpoint_sha256: str


@dataclass(frozen=True, kw_only=True)
class ResultHeader:
    """What holds for all rows of a file."""

    command: str = ""  # the command line that made the file
    reasons: dict[str, str] = field(default_factory=dict)  # metric -> why it is null
    definition: str = METRIC_DEFINITION
    version: str = __version__


_TEXT = tuple(item.name for item in fields(ResultRow) if item.type is str)
_WHOLE = tuple(item.name for item in fields(ResultRow) if item.type is int)


def header_path(path: Path | str) -> Path:
    """`ROWS.header.json` of `ROWS.jsonl`."""
    return Path(path).with_suffix(".header.json")


def write_rows(path: Path | str, rows: Iterable[ResultRow], header: ResultHeader | None = None) -> None:
    """Write rows, and the header beside them, each file atomically."""
    lines = [json.dumps(asdict(row), allow_nan=False) + "\n" for row in rows]
    write_json(header_path(path), asdict(header or ResultHeader()))
    write_text(path, "".join(lines))


def read_header(path: Path | str) -> ResultHeader:
    """Header of the result file `path`; an empty one when there is none (rows joined by hand)."""
    side = header_path(path)
    if not side.exists():
        return ResultHeader()
    value = read_json(side)
    reasons = value.get("reasons") if isinstance(value, dict) else None
    if not isinstance(value, dict) or not isinstance(reasons, dict):
        raise InputError(f"{side}: expected the header of a result file with 'reasons', found something else")
    return ResultHeader(
        command=str(value.get("command", "")),
        reasons={str(key): str(reason) for key, reason in reasons.items()},
        definition=str(value.get("definition", METRIC_DEFINITION)),
        version=str(value.get("version", "")),
    )


def read_rows(path: Path | str) -> list[ResultRow]:
    """Rows of a result file in file order; `InputError` names the line that is not one. Unknown fields are ignored."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); expected a JSONL file of result rows") from error
    # Lines end at "\n" only: str.splitlines would also cut at characters that JSON allows inside a string.
    lines = enumerate(text.split("\n"), start=1)
    return [_row(line, f"{path} line {number}") for number, line in lines if line.strip()]


def _row(line: str, where: str) -> ResultRow:
    value = parse_json(line, name=where)
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a JSON object, found {line[:60]!r}")
    known = [item.name for item in fields(ResultRow)]
    missing = [name for name in known if name not in value]
    if missing:
        raise InputError(f"{where}: missing {', '.join(missing)}; write the file with 'carstudio evaluate'")
    return ResultRow(**{name: _checked(name, value[name], where) for name in known})


def _checked(name: str, value: Any, where: str) -> Any:
    if name in _TEXT:
        if not isinstance(value, str):
            raise InputError(f"{where}: {name} must be a string, found {shortened(value)}")
        return value
    if name in _WHOLE:
        if isinstance(value, bool) or not isinstance(value, int):
            raise InputError(f"{where}: {name} must be a whole number, found {shortened(value)}")
        return value
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise InputError(f"{where}: {name} must be a finite number or null, found {shortened(value)}")
    return float(value)
