"""`carstudio export`: a car -> GLB or splat PLY."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro

from carstudio.commands.command import Outcome, Output
from carstudio.commands.opening import open_car
from carstudio.errors import InputError
from carstudio.export.mesh import MeshConfig, fuse, take_views, write_glb
from carstudio.export.splats import metric_splats, write_ply
from carstudio.files import require_writable
from carstudio.models.car_gaussians import CarGaussians


@dataclass(frozen=True, kw_only=True)
class Export(Output):
    """Write a car for other programs: metres, +Y up, +Z front, ground at Y = 0, centred in X and Z."""

    car: tyro.conf.Positional[Path]
    """Folder of the car (`carstudio fit`), or the name of a bundled one (suv-red, sedan-white, hatchback-grey)."""
    format: Literal["glb", "ply"]
    """glb: a mesh with vertex colours, of any model. ply: Gaussians as splat viewers read them (car-gaussians only)."""
    out: Path
    """The file."""
    model: Path | None = None
    """Folder of the run the car was made with; the bundled model of that name when absent."""
    grid: int = 128
    """glb: cells along the car's length."""
    views: int = 42
    """glb: renderings that are fused."""
    size: int = 192
    """glb: side of a rendering, px."""

    def run(self) -> Outcome:
        """Write the file."""
        require_writable(self.out)
        model, car = open_car(self.car, self.model)
        size = torch.tensor(car.size)
        if self.format == "ply":
            if not isinstance(model, CarGaussians):
                raise InputError(f"--format ply: {car.model_name} is not made of Gaussians; take --format glb")
            with torch.no_grad():
                splats = metric_splats(model.decode(car.latents), size)
            write_ply(self.out, splats)
            return Outcome(f"{self.out}: {len(splats.mean)} splats", {"out": str(self.out), "splats": len(splats.mean)})
        config = MeshConfig(grid=self.grid, views=self.views, view_px=self.size)
        with self.progress() as report:
            surface = fuse(take_views(model, car.latents, size, config, report), size, self.grid)
        write_glb(self.out, surface, size, car.instance_id)
        counts = {"vertices": len(surface.vertices), "faces": len(surface.faces)}
        return Outcome(f"{self.out}: {counts['faces']} triangles", {"out": str(self.out), **counts})
