"""Car-Studio: from photographs of cars to metric, camera-registered, editable 3-D cars in driving scenes."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

# Public name -> module that defines it; loaded on first use, so that `import carstudio` stays quick.
_HOMES = {
    "BakedCar": "carstudio.models.baked",
    "Camera": "carstudio.geometry.camera",
    "Box3D": "carstudio.geometry.box3d",
    "InputError": "carstudio.errors",
    "Scene": "carstudio.scene.graph",
    "bake": "carstudio.models.baked",
    "load_model": "carstudio.training.checkpoint",
    "open_store": "carstudio.dataset.store",
}
__all__ = ["BakedCar", "Box3D", "Camera", "InputError", "Scene", "bake", "load_model", "open_store"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'carstudio' has no attribute {name!r}")
