"""Models and cars that come with the package: from synthetic photographs alone, ready right after installing."""

from importlib.resources import files
from pathlib import Path

_FOLDER = "bundled"
_MODEL, _CAR = "model.json", "car.json"


def bundled_models() -> dict[str, Path]:
    """Name -> folder."""
    return _bundled(_MODEL)


def bundled_cars() -> dict[str, Path]:
    """Name -> folder."""
    return _bundled(_CAR)


def find_model(path_or_name: Path | str) -> Path:
    """A run's folder as it is; a bundled model's where no folder of that name exists."""
    path = Path(path_or_name)
    return path if path.exists() else bundled_models().get(str(path_or_name), path)


def find_car_folder(path_or_name: Path | str) -> Path:
    """A car's folder as it is; a bundled car's where no folder of that name exists."""
    path = Path(path_or_name)
    return path if path.exists() else bundled_cars().get(str(path_or_name), path)


def _bundled(description: str) -> dict[str, Path]:
    root = Path(str(files("carstudio"))) / _FOLDER
    return {path.parent.name: path.parent for path in sorted(root.glob(f"*/{description}"))}
