"""Command lines beside a store (`runs/`): who made it and how, outside what the checksums cover."""

import json
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from carstudio.dataset.manifest import is_finished_store
from carstudio.errors import InputError
from carstudio.files import read_json, write_json

CHANGES_NOTHING = ("out", "workers")  # settings that may differ between two runs with the same result


def write_run(store_path: Path | str, config: dict[str, Any]) -> Path:
    """Write `runs/NNNN.json` with version, command line and resolved configuration; returns the file."""
    folder = Path(store_path) / "runs"
    number = 1 + max((int(path.stem) for path in folder.glob("[0-9]*.json") if path.stem.isdigit()), default=0)
    path = folder / f"{number:04d}.json"
    run = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "carstudio": version("carstudio"),
        "command": sys.argv,
        "config": _as_json(config),
    }
    write_json(path, run)
    return path


def is_made_already(store_path: Path | str, config: dict[str, Any]) -> bool:
    """Whether a finished store is there whose last run had this version and this configuration.

    A job that was killed just after its last write is then done when it is started again, and not refused.
    """
    path = Path(store_path)
    if not is_finished_store(path):
        return False
    runs = sorted((path / "runs").glob("[0-9]*.json"))
    try:
        last = read_json(runs[-1])
        found, wanted = dict(last["config"]), _as_json(config)
        is_same_version = last["carstudio"] == version("carstudio")
    except (InputError, IndexError, KeyError, TypeError, ValueError):  # `runs/` may be missing: it is not the data's
        return False
    for name in CHANGES_NOTHING:
        found.pop(name, None)
        wanted.pop(name, None)
    return is_same_version and found == wanted


def read_configs(store_path: Path | str) -> list[dict[str, Any]]:
    """Settings of all runs that wrote here, those of the stores that were merged included.

    A run file that is none is skipped: `runs/` is not part of the data.
    """
    found: list[dict[str, Any]] = []
    for path in sorted((Path(store_path) / "runs").glob("[0-9]*.json")):
        try:
            config = read_json(path)["config"]
        except (InputError, KeyError, TypeError):
            continue
        if isinstance(config, dict):
            merged = config.get("configs", [])
            found += (
                [config, *(one for one in merged if isinstance(one, dict))] if isinstance(merged, list) else [config]
            )
    return found


def _as_json(config: dict[str, Any]) -> dict[str, Any]:
    value: dict[str, Any] = json.loads(json.dumps(config, default=str))
    return value
