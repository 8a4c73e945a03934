"""The training log: one JSON object per line, and TensorBoard where it is installed."""

import json
import os
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from carstudio.errors import InputError, StorageError
from carstudio.files import parse_json, write_text

LOG = "log.jsonl"


class TrainingLog:
    """Appends to `log.jsonl`; opening at a step drops what a killed run logged beyond it, so no line is double.

    A row holds nothing that depends on the clock unless the run's length does, so that equal runs give equal bytes.
    """

    def __init__(self, folder: Path, *, resume_step: int) -> None:
        self.path = folder / LOG
        kept = [row for row in read_log(self.path) if row["step"] <= resume_step] if self.path.exists() else []
        write_text(self.path, "".join(json.dumps(row) + "\n" for row in kept))
        self.last_row: dict[str, Any] = kept[-1] if kept else {}
        self._file = self.path.open("a", encoding="utf-8")
        self._board = _summary_writer(folder / "tensorboard", resume_step)

    def write(self, row: dict[str, Any]) -> None:
        """Add one line (`row["step"]` is the number of finished steps)."""
        try:
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()
        except OSError as error:  # half a line may stand there now; reading drops it
            raise StorageError(self.path, error.strerror or error) from error
        if self._board is not None:
            for key, value in row.items():
                if key != "step" and isinstance(value, (int, float)):
                    self._board.add_scalar(key, value, row["step"])

    def sync(self) -> None:
        """Bring all lines to the disk: a checkpoint that goes on after them may follow."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise StorageError(self.path, error.strerror or error) from error

    def close(self) -> None:
        """Close; every line was flushed when it was written."""
        with suppress(OSError):  # the rest of a line that did not fit on a full disk
            self._file.close()
        if self._board is not None:
            self._board.close()


def _summary_writer(folder: Path, resume_step: int) -> Any:
    if find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=resume_step + 1)


def read_log(path: Path) -> list[dict[str, Any]]:
    """Rows of a log; a last line that a kill cut short is dropped, any other broken line is an `InputError`."""
    lines = path.read_bytes().split(b"\n")
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            rows.append(_row(line, f"{path} line {number}"))
        except InputError:
            if number < len(lines):  # a whole line ends with a line break, so that one more, empty, comes after it
                raise
    return rows


def _row(line: bytes, where: str) -> dict[str, Any]:
    row = parse_json(line, name=where)
    if not isinstance(row, dict) or isinstance(row.get("step"), bool) or not isinstance(row.get("step"), int):
        raise InputError(f"{where}: expected a JSON object with a step, found {line[:60].decode(errors='replace')!r}")
    return row
