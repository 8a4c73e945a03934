"""Command lines beside a store (`runs/`): who made it and how, outside what the checksums cover."""

import json
import sys
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from carstudio.files import write_json


def write_run(store_path: Path | str, config: dict[str, Any]) -> Path:
    """Write `runs/NNNN.json` with version, command line and resolved configuration; returns the file."""
    folder = Path(store_path) / "runs"
    number = 1 + max((int(path.stem) for path in folder.glob("[0-9]*.json") if path.stem.isdigit()), default=0)
    path = folder / f"{number:04d}.json"
    run = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "carstudio": version("carstudio"),
        "command": sys.argv,
        "config": json.loads(json.dumps(config, default=str)),
    }
    write_json(path, run)
    return path
