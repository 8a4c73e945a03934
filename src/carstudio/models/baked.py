"""A car decoded once into its Gaussians and drawn from anywhere at several hundred pictures a second on one core.

`BakedCar.render` is a preview of `render_image`: sorted by tiles instead of rays (`rendering.gaussians.screen`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.models.car_gaussians import CarGaussians
from carstudio.models.interface import NEAR_M, CategoryModel, Latents, render_image
from carstudio.rendering.gaussians.cloud import GaussianCloud
from carstudio.rendering.gaussians.ellipses import ellipses_of
from carstudio.rendering.gaussians.projection import BakedCloud, bake_cloud, project
from carstudio.rendering.gaussians.screen import draw_ellipses
from carstudio.rendering.gaussians.tiles import TILE_PX
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Rendering


@dataclass(frozen=True)
class BakedCar:
    """Gaussians of one car, on the CPU; nothing of the model or the photo is needed any more."""

    cloud: GaussianCloud
    splatting: SplattingConfig
    arrays: BakedCloud

    @torch.no_grad()
    def render(self, camera: Camera, box: Box3D) -> dict[str, Float[Tensor, "height width *channel"]]:
        """Images rgb (premultiplied, over black), opacity and depth_m as `render_image` gives them, on the CPU.

        `box` is a batch of one. Where it reaches to the camera's plane (a camera in the car or beside it) the picture
        is traced ray by ray, exactly and slowly.
        """
        camera, box = camera.to("cpu"), box.to("cpu")
        if bool((box.corners()[0, :, 2] < NEAR_M).any()):
            return render_image(_Traced(self), camera, Latents(torch.zeros(1, 0), torch.zeros(1, 0)), box)
        ellipses = ellipses_of(project(self.arrays, camera, box, widen=self.splatting.widen))
        image = torch.from_numpy(draw_ellipses(ellipses, camera.width, camera.height))
        return {"rgb": image[..., :3], "opacity": image[..., 3], "depth_m": image[..., 4]}


@torch.no_grad()
def bake(model: CategoryModel, latents: Latents) -> BakedCar:
    """Decode a car (a batch of one) for previews; `InputError` for a model that is not made of Gaussians."""
    if not isinstance(model, CarGaussians):
        raise InputError(
            f"only models made of Gaussians (car-gaussians) can be baked, found {type(model).__name__}; draw it with "
            "render_image, or without --preview"
        )
    if len(latents.shape) != 1:
        raise InputError(f"one car at a time can be baked, found latents of {len(latents.shape)}")
    decoded = {name: None if part is None else part.float().cpu() for name, part in vars(model.decode(latents)).items()}
    if not all(bool(part.isfinite().all()) for part in decoded.values() if part is not None):
        raise InputError("the car's Gaussians are not finite numbers: the model's weights are damaged; use another run")
    cloud = GaussianCloud(**decoded)  # type: ignore[arg-type]
    return BakedCar(cloud, model.config.splatting, bake_cloud(cloud))


class _Traced(CategoryModel):
    """A baked car as a model that has but this one."""

    tile_px = TILE_PX
    chunk_rays = CarGaussians.chunk_rays

    def __init__(self, car: BakedCar) -> None:
        super().__init__()
        self.car = car

    def render_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Rendering, ...]:
        return (render_cloud(self.car.cloud, rays, to_canonical(rays, box), self.car.splatting),)
