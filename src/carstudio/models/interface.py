"""What every category model offers: encode photos to latents, trace rays through the car, render.

Fitting, editing, evaluation, export and the viewer know only this. One car per batch entry.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import Rendering, Segments, composite

NEAR_M = 0.1  # corners nearer to the camera's plane have no place in the image


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
class PixelFeatures:
    """A feature map over the photo that was encoded, and the camera and box that say where a point of the car is in it.

    The map covers the whole image of `camera`, at any resolution.
    """

    map: Float[Tensor, "batch feature rows columns"]
    camera: Camera
    box: Box3D

    def select(self, rows: slice | Tensor) -> "PixelFeatures":
        """Some of the batch entries."""
        camera = Camera(self.camera.intrinsics[rows], self.camera.width, self.camera.height)
        return PixelFeatures(self.map[rows], camera, self.box.select(rows))


@dataclass(frozen=True)
class Latents:
    """Codes of cars: what they are shaped like and what they look like (the paper's z_shape, z_texture).

    Models with pixel-aligned features (PixelNeRF) have `pixels` as well, and may have codes of length 0; what is done
    with codes (fitting, recolouring, the car file) is not possible with those.
    """

    shape: Float[Tensor, "batch shape_code"]
    texture: Float[Tensor, "batch texture_code"]
    pixels: PixelFeatures | None = None

    def select(self, index: int | slice | Tensor) -> "Latents":
        """Latents of some of the batch entries, still a batch."""
        rows = slice(index, index + 1) if isinstance(index, int) else index
        pixels = None if self.pixels is None else self.pixels.select(rows)
        return Latents(self.shape[rows], self.texture[rows], pixels)


class CategoryModel(nn.Module):
    """Base of all models. Subclasses give `encode` and `trace_levels`, and the side of the images they encode."""

    encoder_side_px: int
    tile_px: int = 1
    """Side of the square of neighbouring pixels whose rays the model likes to get together when an image is drawn."""
    is_coded: bool = True
    """Whether a car is its two codes; not where features of single pixels are looked up."""
    chunk_rays: int = 8192
    """Rays of an image that are traced at a time, for memory's sake."""

    def load_pretrained_parts(self) -> str:
        """Load what a config asks to start from (an ImageNet encoder); says in words what the encoder starts from."""
        return "random weights"

    def code_parameters(self) -> tuple[nn.Parameter, ...]:
        """Parameters that are codes of the cars trained on (auto-decoders); they may learn at a rate of their own."""
        return ()

    def template_parameters(self) -> tuple[nn.Parameter, ...]:
        """Parameters that are a mean car's own numbers, no network's weights; they may learn at a rate of their own."""
        return ()

    def field_parameters(self) -> list[tuple[str, nn.Parameter]]:
        """What fitting a car may change beside its latents: all that acts after encoding, unless a model says less."""
        encoding = ("encoder.", "shape_head.", "texture_head.", "shape_norm.", "texture_norm.", "colour_skip.")
        codes = {id(parameter) for parameter in self.code_parameters()}
        return [(n, p) for n, p in self.named_parameters() if not n.startswith(encoding) and id(p) not in codes]

    def colour_parameters(self) -> list[tuple[str, nn.Parameter]]:
        """Those of `field_parameters` that change colours and nothing else; none where a model does not tell."""
        return []

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

    def draw(self, camera: Camera, latents: Latents, box: Box3D) -> Float[Tensor, "height width 5"] | None:
        """What `render` gives for all rays of a camera (rgb, opacity, depth in metres), by a shorter way that takes no
        gradients; what rays beside the box would show does not matter. None: there is none, here or at all.

        The camera has the box wholly in front of it; one car.
        """
        return None


@torch.no_grad()
def render_image(
    model: CategoryModel, camera: Camera, latents: Latents, box: Box3D, *, chunk: int | None = None
) -> dict[str, Float[Tensor, "height width *channel"]]:
    """rgb, opacity and depth_m images of one car (batches of one) through one camera, `chunk` rays at a time.

    Only rays that hit the box (or whose tile has one that does) are traced; the others are black, transparent, of depth
    0. The chunk (the model's own by default) changes no pixel. A model that can draw a whole picture at once (`draw`)
    does, unless a chunk is asked for. `InputError` when the weights, though finite themselves, give numbers that are
    not.
    """
    x, y, width, height = window_of(box, camera)
    seen = camera.crop(x, y, width, height)
    rays = image_rays(seen)
    hit = to_canonical(rays, box).hit[0]
    can_draw = chunk is None and bool(hit.any()) and bool((box.corners()[0, :, 2] >= NEAR_M).all())
    drawn = model.draw(seen, latents, box) if can_draw else None
    if drawn is not None:
        part = drawn.flatten(0, 1) * hit[:, None]
    else:
        part = rays.directions.new_zeros(width * height, 5)
        tiles = tiles_that_hit(hit.view(height, width), model.tile_px)
        for rows in tiles.split(chunk or model.chunk_rays) if len(tiles) else ():
            found = model.render(rays.select(rows), latents, box)
            part[rows] = torch.cat([found.rgb[0], found.opacity[0, :, None], found.depth_m[0, :, None]], dim=-1)
    if not bool(part.isfinite().all()):
        raise InputError(
            "the model's picture is not made of finite numbers: its weights are damaged, or its training ran away; use "
            "another run"
        )
    image = part.new_zeros(camera.height, camera.width, 5)
    image[y : y + height, x : x + width] = part.unflatten(0, (height, width))
    return {"rgb": image[..., :3], "opacity": image[..., 3], "depth_m": image[..., 4]}


def window_of(box: Box3D, camera: Camera) -> tuple[int, int, int, int]:
    """x, y, width and height (px) of a part of the image that no ray outside of hits the box (a batch of one).

    The whole image where the box reaches to the camera's plane; empty where it is out of sight.
    """
    corners = box.corners()[0]
    if bool((corners[:, 2] < NEAR_M).any()):
        return 0, 0, camera.width, camera.height
    points = camera.project(corners)
    size = points.new_tensor([camera.width, camera.height])
    low = (points.amin(dim=0) - 1).floor().clamp(min=0).minimum(size)
    high = (points.amax(dim=0) + 1).ceil().clamp(min=0).minimum(size)
    (x0, y0), (x1, y1) = low.int().tolist(), high.int().tolist()
    return x0, y0, max(0, x1 - x0), max(0, y1 - y0)


def tiles_that_hit(hit: Bool[Tensor, "height width"], side: int) -> Int[Tensor, " pixel"]:
    """Pixel numbers of all side x side tiles with a hit, tile by tile; tiles at the edge repeat their pixels."""
    height, width = hit.shape
    padded = torch.nn.functional.pad(hit, (0, -width % side, 0, -height % side))
    touched = padded.unflatten(0, (-1, side)).unflatten(2, (-1, side)).any(dim=3).any(dim=1)
    row, column = touched.nonzero().unbind(-1)
    inside = torch.arange(side, device=hit.device)
    rows = (row[:, None] * side + inside).clamp(max=height - 1)
    columns = (column[:, None] * side + inside).clamp(max=width - 1)
    return (rows[:, :, None] * width + columns[:, None]).flatten()
