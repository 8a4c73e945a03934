"""`carstudio fit`: a trained model and photographs of one car -> that car, in a file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from carstudio.commands.command import Outcome, Output, provenance, split_of
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import PatchStore, open_store
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.fitting.car_file import Car, save_car
from carstudio.fitting.optimise import FitConfig
from carstudio.models.interface import Latents
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.patch_fitting import fit_patches


@dataclass(frozen=True, kw_only=True)
class Fit(Output):
    """Fit one car to its photographs: latents start where the encoder puts them, then explain the pixels."""

    model: tyro.conf.Positional[Path]
    """Folder of the run."""
    data: Path
    """The CarPatch3D store with the car's photographs."""
    instance: str
    """The car: an instance id; or a patch id, for a car known from one photograph alone."""
    out: Path
    """Folder of the car: car.safetensors and car.json."""
    split: str | None = None
    """Take only the photographs of this split's training part, so that its others can be scored honestly."""
    config: tyro.conf.OmitArgPrefixes[FitConfig] = field(default_factory=FitConfig)
    """How it is fitted."""
    rays: int = 256
    """Pixels per photograph and step."""
    seed: int = 0
    """Which pixels."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def run(self) -> Outcome:
        """Encode, fit, write."""
        if self.rays < 1:
            raise InputError(f"--rays must be at least 1, found {self.rays}")
        device = pick_device(self.device)
        model, description = load_model(self.model, device=device), describe_model(self.model)
        store = open_store(self.data)
        patch_ids = photographs_of(store, self.instance, split_of(self.split))
        cache = PatchCache(store, model.encoder_side_px)
        patches = [cache[patch_id] for patch_id in patch_ids]
        with self.progress() as report:
            fitted = fit_patches(model, patches, self.config, rays=self.rays, seed=self.seed, report=report)
        licence = store.record(patch_ids[0]).licence
        size = patches[0].box.size.tolist()
        car = Car(
            latents=Latents(fitted.latents.shape.cpu(), fitted.latents.texture.cpu()),
            size=(size[0], size[1], size[2]),
            model_name=str(description.provenance.get("recipe", Path(self.model).name)),
            model_sha256=description.sha256,
            instance_id=patches[0].instance_id,
            licence=licence,
            weights={name: weight.cpu() for name, weight in fitted.weights.items()},
            provenance={
                **provenance(),
                "patches": patch_ids,
                "data_sha256": store.data_sha256,
                "steps": fitted.steps,
                "held_out_loss": [list(point) for point in fitted.curve],
            },
        )
        save_car(self.out, car)
        text = f"{self.out}: {car.instance_id} from {len(patches)} photographs, {fitted.steps} steps"
        if fitted.curve:
            text += f"; loss on held-out pixels {fitted.curve[0][1]:.4f} -> {min(v for _, v in fitted.curve):.4f}"
        values: dict[str, Any] = {"out": str(self.out), "instance_id": car.instance_id, "patches": patch_ids}
        return Outcome(text, values | {"steps": fitted.steps, "held_out_loss": car.provenance["held_out_loss"]})


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
