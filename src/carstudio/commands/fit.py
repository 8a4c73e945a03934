"""`carstudio fit`: a trained model and photographs of cars -> those cars, each in a file."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from carstudio.commands.command import Outcome, Output, provenance, split_of
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore, open_store
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.fitting.car_file import DESCRIPTION, Car, load_car, save_car
from carstudio.fitting.optimise import FitConfig, Fitted
from carstudio.models.interface import CategoryModel
from carstudio.progress import Report
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.patch_fitting import fit_cars, held_out_places

ALL = "all"
CARS_PER_BATCH = 8


@dataclass(frozen=True, kw_only=True)
class Fit(Output):
    """Fit cars to their photographs: latents start where the encoder puts them, then explain the pixels."""

    model: tyro.conf.Positional[Path]
    """Folder of the run, or a bundled model's name."""
    data: Path
    """The CarPatch3D store with the cars' photographs."""
    instance: tuple[str, ...]
    """The car: an instance id; or a patch id, for a car known from one photograph alone. Several ids, or `all`, make
    several cars."""
    out: Path
    """Folder of the car: car.safetensors and car.json; of several cars, one such folder each in it. Cars that are there
    already, fitted to the same photographs in the same way, stay."""
    split: str | None = None
    """Take only the photographs of this split's training part, so that its others can be scored honestly."""
    config: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
    """How they are fitted."""
    rays: int = 256
    """Pixels per photograph and step."""
    cars_per_batch: int | None = None
    """Cars fitted at a time: 8 when absent, or 1 where the field is fitted too, since the cars of a batch share it (as
    the paper does with those of one log) and mix their unseen sides."""
    seed: int = 0
    """Which pixels."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def saved(self) -> str:
        """Cars are written batch by batch."""
        return f"the cars that are whole stand in {self.out}; the same command keeps them and goes on"

    def run(self) -> Outcome:
        """Encode, fit, write."""
        at_once = self._at_once()
        if self.rays < 1 or at_once < 1:
            raise InputError(f"--rays and --cars-per-batch must be at least 1, found {self.rays} and {at_once}")
        model, store = load_model(self.model, device=pick_device(self.device)), open_store(self.data)
        if not model.is_coded:
            raise InputError(f"{self.model}: looks cars up in their photos and has no codes to keep in a file")
        split = split_of(self.split)
        names = instances_of(store, split) if self.instance == (ALL,) else list(self.instance)
        photos = {name: photographs_of(store, name, split) for name in names}
        folders = dict(zip(names, car_folders(self.out, names), strict=True))
        missing = [name for name in names if len(names) == 1 or not self._is_there(folders[name], photos[name])]
        told = [self._told(folders[name], load_car(folders[name])) for name in names if name not in missing]
        cache = PatchCache(store, model.encoder_side_px)
        with self.progress() as report:
            for first in range(0, len(missing), at_once):
                batch = missing[first : first + at_once]
                told += self._fit(model, store, cache, {n: (photos[n], folders[n]) for n in batch}, report)
                report("cars", first + len(batch), len(missing), "")
        told.sort(key=lambda value: folders_in_order(folders, value["out"]))
        text = "\n".join(_line(value) for value in told)
        return Outcome(text, told[0] if len(told) == 1 else {"out": str(self.out), "cars": told})

    def _at_once(self) -> int:
        if self.cars_per_batch is not None:
            return self.cars_per_batch
        return 1 if self.config.field_rate else CARS_PER_BATCH

    def _fit(
        self,
        model: CategoryModel,
        store: PatchStore,
        cache: PatchCache,
        batch: dict[str, tuple[list[str], Path]],
        report: Report,
    ) -> list[dict[str, Any]]:
        cars = [[cache[patch_id] for patch_id in patch_ids] for patch_ids, _ in batch.values()]
        fitted = fit_cars(model, cars, self.config, rays=self.rays, seed=self.seed, report=report)
        first, told = 0, []
        for index, (patch_ids, folder) in enumerate(batch.values()):
            car = self._car(fitted, index, first, cars[index], store, patch_ids)
            save_car(folder, car)
            told.append(self._told(folder, car))
            first += len(patch_ids)
        return told

    def _car(
        self,
        fitted: Fitted,
        index: int,
        first: int,
        patches: list[PreparedPatch],
        store: PatchStore,
        patch_ids: list[str],
    ) -> Car:
        """Car `index` of a batch, whose photographs begin at row `first` of the batch's."""
        description = describe_model(self.model)
        latents = fitted.latents.select(index)
        size = patches[0].box.size if fitted.box is None else fitted.box.size[first]
        length, height, width = (float(side) for side in size)
        about: dict[str, Any] = {"patches": patch_ids, "data_sha256": store.data_sha256, "steps": fitted.steps}
        curve = fitted.curves[index] if fitted.curves else ()
        if self.config.hold_out_views:
            places = held_out_places(len(patch_ids), self.config.hold_out_views)
            about["hold_out_views"] = [patch_ids[place] for place in places]
        if fitted.box is not None:
            about["boxes"] = [_box_value(fitted, row) for row in range(first, first + len(patch_ids))]
        return Car(
            latents=type(latents)(latents.shape.cpu(), latents.texture.cpu()),
            size=(length, height, width),
            model_name=str(description.provenance.get("recipe", Path(self.model).name)),
            model_sha256=description.sha256,
            instance_id=patches[0].instance_id,
            licence=store.record(patch_ids[0]).licence,
            weights={name: weight.cpu() for name, weight in fitted.weights.items()},
            provenance={
                **provenance(),
                **about,
                "settings": self._settings(),
                "held_out_loss": [list(point) for point in curve],
            },
        )

    def _settings(self) -> str:
        return repr((self.config, self.rays, self.seed, self._at_once() if self.config.field_rate else None))

    def _is_there(self, folder: Path, patch_ids: list[str]) -> bool:
        """Whether the very car was written by an earlier run."""
        if not (folder / DESCRIPTION).exists():
            return False
        try:
            car = load_car(folder)
        except InputError:
            return False
        made = car.provenance
        same = made.get("patches") == patch_ids and made.get("settings") == self._settings()
        return same and car.model_sha256 == describe_model(self.model).sha256

    def _told(self, folder: Path, car: Car) -> dict[str, Any]:
        made = car.provenance
        told = {"out": str(folder), "instance_id": car.instance_id}
        return told | {key: made[key] for key in ("patches", "steps", "held_out_loss")}


def folders_in_order(folders: dict[str, Path], out: str) -> int:
    """Place of a car among those asked for."""
    return [str(folder) for folder in folders.values()].index(out)


def _line(told: dict[str, Any]) -> str:
    text = f"{told['out']}: {told['instance_id']} from {len(told['patches'])} photographs, {told['steps']} steps"
    curve = told["held_out_loss"]
    return text + (f"; held-out loss {curve[0][1]:.4f} -> {min(v for _, v in curve):.4f}" if curve else "")


def _box_value(fitted: Fitted, row: int) -> dict[str, list[Any]]:
    assert fitted.box is not None
    return {name: getattr(fitted.box, name)[row].tolist() for name in ("center", "size", "rotation")}


def car_folders(out: Path, names: list[str]) -> list[Path]:
    """Where cars are written: one alone in `out` itself, several below it, under names that suit any file system."""
    if len(names) == 1:
        return [out]
    plain = [re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "car" for name in names]
    return [out / (name if plain.count(name) == 1 else f"{name}-{i}") for i, name in enumerate(plain)]


def instances_of(store: PatchStore, split: str | None) -> list[str]:
    """Cars with a kept photograph and a 3-D box, in the store's order."""
    wanted = set(store.patch_ids(kept=True, split=split, part="train" if split else "all"))
    table = store.table(["patch_id", "instance_id", "box_center"])
    rows = zip(*(table[column].to_pylist() for column in ("patch_id", "instance_id", "box_center")), strict=True)
    found = list(dict.fromkeys(car for patch, car, center in rows if patch in wanted and center is not None))
    if not found:
        raise InputError(f"{store.path}: no kept photograph with a 3-D box; see `dataset info`")
    return found


def photographs_of(store: PatchStore, name: str, split: str | None) -> list[str]:
    """Kept patches of a car (or the one patch of that id) with a 3-D box; `InputError` when there are none."""
    kept = store.patch_ids(kept=True, split=split, part="train" if split else "all")
    table = store.table(["patch_id", "instance_id", "box_center"])
    rows = zip(*(table[column].to_pylist() for column in ("patch_id", "instance_id", "box_center")), strict=True)
    wanted = set(kept)
    found = [
        patch
        for patch, instance, center in rows
        if name in (patch, instance) and patch in wanted and center is not None
    ]
    if not found:
        where = "" if split is None else f" in the training part of split {split!r}"
        raise InputError(f"{store.path}: no kept photograph with a 3-D box of {name!r}{where}; see `dataset info`")
    return found
