"""Models that come with the package: trained on synthetic photographs alone, ready right after installing."""

from importlib.resources import files
from pathlib import Path

_FOLDER = "bundled"
_DESCRIPTION = "model.json"


def bundled_models() -> dict[str, Path]:
    """Name -> folder."""
    root = Path(str(files("carstudio"))) / _FOLDER
    return {path.parent.name: path.parent for path in sorted(root.glob(f"*/{_DESCRIPTION}"))}


def find_model(path_or_name: Path | str) -> Path:
    """A run's folder as it is; a bundled model's where no folder of that name exists."""
    path = Path(path_or_name)
    return path if path.exists() else bundled_models().get(str(path_or_name), path)
