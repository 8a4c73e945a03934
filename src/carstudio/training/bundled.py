"""Models and cars that come with the package: from synthetic photographs alone, ready right after installing."""

from importlib.resources import files
from pathlib import Path

from carstudio.fitting import car_file

_FOLDER = "bundled"
_MODEL = "model.json"


def bundled_models() -> dict[str, Path]:
    """Name -> folder."""
    return _bundled(_MODEL)


def bundled_cars() -> dict[str, Path]:
    """Name -> folder."""
    return _bundled(car_file.DESCRIPTION)


def find_model(path_or_name: Path | str) -> Path:
    """A run's folder as it is; a bundled model's where no folder of that name exists."""
    return _found(path_or_name, bundled_models())


def find_car_folder(path_or_name: Path | str) -> Path:
    """A car's folder as it is; a bundled car's where no folder of that name exists."""
    return _found(path_or_name, bundled_cars())


def _found(path_or_name: Path | str, bundled: dict[str, Path]) -> Path:
    path = Path(path_or_name)
    return path if path.exists() else bundled.get(str(path_or_name), path)


def _bundled(description: str) -> dict[str, Path]:
    root = Path(str(files("carstudio"))) / _FOLDER
    return {path.parent.name: path.parent for path in sorted(root.glob(f"*/{description}"))}
