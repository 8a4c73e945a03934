"""`carstudio render`: a car, or a trained model and input photos -> turntables, opacity and depth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from carstudio.commands.command import Outcome, Output
from carstudio.commands.opening import open_car
from carstudio.dataset.store import PatchStore, open_store
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.files import inside
from carstudio.fitting.car_file import DESCRIPTION
from carstudio.geometry.box3d import Box3D
from carstudio.images import write_png
from carstudio.models.interface import CategoryModel, Latents
from carstudio.report.panels import Turntable, encode_patch, turntable
from carstudio.report.video import write_gif, write_mp4
from carstudio.training.bundled import find_car_folder
from carstudio.training.checkpoint import load_model


@dataclass(frozen=True, kw_only=True)
class Render(Output):
    """Novel views of cars: a fitted car, or one photo each encoded by a model; then round the car."""

    model: tyro.conf.Positional[Path]
    """Folder of a car (`carstudio fit`) or of a run, or the name of a bundled car or model."""
    data: Path | None = None
    """Of a run: the CarPatch3D store with the input photos."""
    out: Path
    """One folder per car: input.png (of a run), rgb/ opacity/ depth/, turntable.gif, turntable.mp4."""
    run_of_car: tyro.conf.OmitArgPrefixes[Path | None] = None
    """Of a car: the run it was made with; the bundled model of that name when absent."""
    patches: tuple[str, ...] = ()
    """Patch ids to encode; the first view of --cars unseen cars when absent."""
    cars: int = 4
    """How many cars of the test part when no patch is named."""
    split: str = "instance"
    """Split whose test part the cars are taken from."""
    views: int = 36
    """Views around the car."""
    size: int = 256
    """Side of a view in px."""
    elevation: float = 12.0
    """Height angle of the camera in degrees."""
    preview: bool = False
    """Bake the car into its Gaussians first and draw those sorted by tiles of pixels instead of rays: several times as
    fast on a CPU, nearly the same pictures; for models made of Gaussians (car-gaussians)."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def saved(self) -> str:
        """Pictures, each of them whole."""
        return f"the pictures finished so far are whole in {self.out}"

    def run(self) -> Outcome:
        """Render and write."""
        if self.views < 1 or not 8 <= self.size <= 4096:
            raise InputError(f"--views must be at least 1 and --size 8 to 4096, found {self.views} and {self.size}")
        if (find_car_folder(self.model) / DESCRIPTION).exists():
            return self._render_car()
        if self.data is None:
            raise InputError("--data STORE is needed: a run shows cars that it encodes from a store's photos")
        model = load_model(self.model, device=pick_device(self.device))
        store = open_store(self.data)
        patch_ids = self.patches or tuple(self._first_views(store))
        with self.progress() as report:
            for done, patch_id in enumerate(patch_ids, start=1):
                prepared, latents, box = encode_patch(model, store, patch_id)
                frames = self._frames(model, latents, box)
                folder = inside(self.out, patch_id)  # the id may come from a store that another program wrote
                write_png(folder / "input.png", prepared.rgb.numpy())
                write_turntable(folder, frames)
                report("rendering", done, len(patch_ids), patch_id)
        return Outcome(f"{len(patch_ids)} cars in {self.out}", {"cars": list(patch_ids), "out": str(self.out)})

    def _render_car(self) -> Outcome:
        model, car = open_car(self.model, self.run_of_car)
        device = pick_device(self.device)
        latents = Latents(car.latents.shape.to(device), car.latents.texture.to(device))
        size = torch.tensor([car.size], device=device)
        box = Box3D(torch.zeros(1, 3, device=device), size, torch.eye(3, device=device)[None])
        write_turntable(self.out, self._frames(model.to(device), latents, box))
        return Outcome(f"{car.instance_id} in {self.out}", {"cars": [car.instance_id], "out": str(self.out)})

    def _frames(self, model: CategoryModel, latents: Latents, box: Box3D) -> Turntable:
        return turntable(
            model,
            latents,
            box,
            views=self.views,
            size_px=self.size,
            elevation_deg=self.elevation,
            preview=self.preview,
        )

    def _first_views(self, store: PatchStore) -> list[str]:
        ids = store.patch_ids(kept=True, split=self.split, part="test")
        table = store.table(["patch_id", "instance_id"])
        instance_of = dict(zip(table["patch_id"].to_pylist(), table["instance_id"].to_pylist(), strict=True))
        first: dict[str, str] = {}
        for patch_id in ids:
            first.setdefault(instance_of[patch_id], patch_id)
        if not first:
            raise InputError(f"{self.data}: no kept patch in the test part of split {self.split!r}; name --patches")
        return list(first.values())[: self.cars]


def write_turntable(folder: Path, frames: Turntable) -> None:
    """Every frame of colour, opacity and depth, and all of them side by side as moving pictures."""
    for name in ("rgb", "opacity", "depth"):
        for i, frame in enumerate(getattr(frames, name)):
            write_png(folder / name / f"{i:03d}.png", frame)
    joined = [np.concatenate(row, axis=1) for row in zip(frames.rgb, frames.opacity, frames.depth, strict=True)]
    write_gif(folder / "turntable.gif", joined, fps=12.0)
    write_mp4(folder / "turntable.mp4", joined, fps=12.0)
