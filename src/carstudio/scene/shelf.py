"""The cars of a scene: CAR folders below `cars/`, found by name, checked by sha256, opened with their model."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from carstudio.dataset.schema import check_id
from carstudio.errors import InputError
from carstudio.files import inside, sha256_file, write_bytes
from carstudio.fitting.car_file import DESCRIPTION, TENSORS, Car, load_car, put_weights, save_car
from carstudio.models.interface import CategoryModel
from carstudio.scene.edit_file import nearest
from carstudio.scene.graph import CarRef, Scene
from carstudio.training.bundled import bundled_cars
from carstudio.training.checkpoint import folder_of_weights, load_model

CARS = "cars"
PATCH, PATCH_MASK, PATCH_DESCRIPTION = "patch.png", "patch_mask.png", "patch.json"
_KEPT_FILES = (TENSORS, DESCRIPTION, PATCH, PATCH_MASK, PATCH_DESCRIPTION)


@dataclass(frozen=True)
class CarShelf:
    """The folder `scene_folder/cars`; further models that cars may be made with; CAR folders from outside (`more`)."""

    scene_folder: Path
    models: tuple[Path, ...] = ()
    more: tuple[Path, ...] = ()
    _loaded: dict[str, CategoryModel] = field(default_factory=dict, repr=False, compare=False)

    def folder(self, name: str) -> Path:
        """Where the car of that name lies."""
        return inside(self.scene_folder / CARS, check_id(name, "car"))

    def names(self) -> list[str]:
        """The cars that are there."""
        return sorted(path.parent.name for path in (self.scene_folder / CARS).glob(f"*/{DESCRIPTION}"))

    def ref(self, name: str) -> CarRef:
        """The reference of a car that is there."""
        return CarRef(name, sha256_file(self.folder(name) / DESCRIPTION))

    def load(self, ref: CarRef) -> Car:
        """Read a car; `InputError` when it is gone or another one has taken its name."""
        car = load_car(self.folder(ref.name))
        if self.ref(ref.name) != ref:
            raise InputError(
                f"{self.folder(ref.name)}: not the car that the scene speaks of (its sha256 differs); make the scene "
                "again, or put the old car back"
            )
        return car

    def model_of(self, car: Car) -> CategoryModel:
        """The model a car was made with, its changed weights put in; `InputError` when it is not to be had."""
        if car.model_sha256 not in self._loaded:
            self._loaded[car.model_sha256] = load_model(self._model_folder(car))
        if not car.weights:
            return self._loaded[car.model_sha256]
        model = load_model(self._model_folder(car))
        put_weights(model, car, name=car.instance_id)
        return model

    def _model_folder(self, car: Car) -> Path:
        folder = folder_of_weights(car.model_sha256, self.models)
        if folder is not None:
            return folder
        raise InputError(
            f"car {car.instance_id!r}: made with the model {car.model_name} (weights {car.model_sha256[:16]}), which "
            "is not bundled; name its folder: --model RUN"
        )

    def add(self, car: Car, name: str) -> CarRef:
        """Write a car under a name (in place of one that had it)."""
        save_car(self.folder(name), car)
        return self.ref(name)

    def take(self, source: Path, name: str | None = None) -> CarRef:
        """Copy a CAR folder onto the shelf, its patch too; the name is followed by a number where it is taken."""
        load_car(source)
        name = free_name(source.name if name is None else name, self, sha256_file(source / DESCRIPTION))
        target = self.folder(name)
        for file in _KEPT_FILES[:1] + _KEPT_FILES[2:] + _KEPT_FILES[1:2]:  # the description, which means "whole", last
            if (source / file).is_file() and not (target / file).is_file():
                write_bytes(target / file, (source / file).read_bytes())
        return self.ref(name)


def free_name(name: str, shelf: CarShelf, sha256: str) -> str:
    """`name`, or `name-2`, ... when another car has it; the same car keeps its name."""
    number = 1
    while True:
        tried = name if number == 1 else f"{name}-{number}"
        path = shelf.folder(tried) / DESCRIPTION
        if not path.is_file() or sha256_file(path) == sha256:
            return tried
        number += 1


def copy_cars(scene: Scene, source: CarShelf, target: CarShelf) -> Scene:
    """The cars of all tracks copied from one scene's folder to another's; the scene as it refers to them there."""
    taken: dict[CarRef, CarRef] = {}
    tracks = {}
    for name, track in scene.tracks.items():
        if track.car is not None and track.car not in taken:
            taken[track.car] = target.take(source.folder(track.car.name), track.car.name)
        tracks[name] = track if track.car is None else replace(track, car=taken[track.car])
    return replace(scene, tracks=tracks)


def find_car(scene: Scene, shelf: CarShelf, name: str) -> CarRef:
    """The car that an edit names: `track:ID`, a car of the scene's `cars/`, one of `shelf.more`, or a bundled one.

    Cars from outside are copied onto the shelf. `InputError` names what there is.
    """
    kind, _, track_id = name.partition(":")
    if kind == "track" and track_id:
        track = scene.tracks.get(track_id)
        if track is None or track.car is None:
            there = [key for key, each in scene.tracks.items() if each.car is not None]
            raise InputError(f"no car of a track {track_id!r}{nearest(track_id, there, 'tracks with a car')}")
        return track.car
    if name in shelf.names():
        return shelf.ref(name)
    outside = {**bundled_cars(), **{path.resolve().name: path for path in shelf.more}}
    if name in outside:
        return shelf.take(outside[name], name)
    known = [*shelf.names(), *outside]
    raise InputError(
        f"no car {name!r}{nearest(name, known, 'cars')}; another track's car is track:ID, a CAR folder is made known "
        "with --cars FOLDER"
    )
