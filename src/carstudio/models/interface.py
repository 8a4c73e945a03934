"""What every category model offers: encode photos to latents, trace rays through the car, render.

Fitting, editing, evaluation, export and the viewer know only this. One car per batch entry.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import Rendering, Segments, composite


@dataclass(frozen=True)
class PatchBatch:
    """Patches as a model's encoder sees them: the whole crop resized to a square, rgb in [0, 1].

    `mask` is 1 on the car, 0 elsewhere (background and unknown). `camera` belongs to the resized image.
    """

    image: Float[Tensor, "batch 3 side side"]
    mask: Float[Tensor, "batch side side"]
    camera: Camera
    box: Box3D
    instance_ids: tuple[str, ...]

    def to(self, device: torch.device | str) -> "PatchBatch":
        """The same patches on another device."""
        return PatchBatch(
            self.image.to(device), self.mask.to(device), self.camera.to(device), self.box.to(device), self.instance_ids
        )


@dataclass(frozen=True)
class Latents:
    """Codes of cars: what they are shaped like and what they look like (the paper's z_shape, z_texture)."""

    shape: Float[Tensor, "batch shape_code"]
    texture: Float[Tensor, "batch texture_code"]

    def select(self, index: int | slice) -> "Latents":
        """Latents of some of the batch entries, still a batch."""
        rows = slice(index, index + 1) if isinstance(index, int) else index
        return Latents(self.shape[rows], self.texture[rows])


class CategoryModel(nn.Module):
    """Base of all models. Subclasses give `encode` and `trace_levels`, and the side of the images they encode."""

    encoder_side_px: int
    tile_px: int = 1
    """Side of the square of neighbouring pixels whose rays the model likes to get together when an image is drawn."""

    def load_pretrained_parts(self) -> str:
        """Load what a config asks to start from (an ImageNet encoder); says in words what the encoder starts from."""
        return "random weights"

    def encode(self, patches: PatchBatch) -> Latents:
        """Latents of the cars in the patches."""
        raise NotImplementedError

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        """Segments along metric rays for each sampling level, the last being the result.

        `rays` are in the camera frame that `box` stands in. A generator makes the sampling random (training).
        """
        raise NotImplementedError

    def render_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Rendering, ...]:
        """Composited segments of each level, what training compares; a model may have a shorter way to them."""
        levels = self.trace_levels(rays, latents, box, generator)
        with torch.autocast(rays.directions.device.type, enabled=False):
            return tuple(composite(segments) for segments in levels)

    def trace(self, rays: Rays, latents: Latents, box: Box3D) -> Segments:
        """Segments in metres, ordered along each ray; several cars and a background merge through them."""
        return self.trace_levels(rays, latents, box)[-1]

    def render(self, rays: Rays, latents: Latents, box: Box3D) -> Rendering:
        """Composited segments: colour over black, opacity, distance and depth in metres."""
        return self.render_levels(rays, latents, box)[-1]


@torch.no_grad()
def render_image(
    model: CategoryModel, camera: Camera, latents: Latents, box: Box3D, *, chunk: int = 8192
) -> dict[str, Float[Tensor, "height width *channel"]]:
    """rgb, opacity and depth_m images of one car (batches of one) through one camera, `chunk` rays at a time.

    Only rays that hit the box (or whose tile has one that does) are traced; the others are black, transparent, of depth
    0. The chunk changes no pixel.
    """
    rays = image_rays(camera)
    hit = _tiles_that_hit(to_canonical(rays, box).hit.view(camera.height, camera.width), model.tile_px)
    count = camera.width * camera.height
    rgb = rays.directions.new_zeros(count, 3)
    opacity, depth = rays.directions.new_zeros(count), rays.directions.new_zeros(count)
    for rows in hit.split(chunk):
        part = model.render(rays.select(rows), latents, box)
        rgb[rows], opacity[rows], depth[rows] = part.rgb[0], part.opacity[0], part.depth_m[0]
    shape = (camera.height, camera.width)
    return {"rgb": rgb.reshape(*shape, 3), "opacity": opacity.reshape(shape), "depth_m": depth.reshape(shape)}


def _tiles_that_hit(hit: Bool[Tensor, "height width"], side: int) -> Int[Tensor, " pixel"]:
    """Pixel numbers of all side x side tiles with a hit, tile by tile; tiles at the edge repeat their pixels."""
    height, width = hit.shape
    padded = torch.nn.functional.pad(hit, (0, -width % side, 0, -height % side))
    touched = padded.unflatten(0, (-1, side)).unflatten(2, (-1, side)).any(dim=3).any(dim=1)
    row, column = touched.nonzero().unbind(-1)
    inside = torch.arange(side, device=hit.device)
    rows = (row[:, None] * side + inside).clamp(max=height - 1)
    columns = (column[:, None] * side + inside).clamp(max=width - 1)
    return (rows[:, :, None] * width + columns[:, None]).flatten()
