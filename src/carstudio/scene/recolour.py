"""Another colour for a car, three ways. The shape code is never touched, so its shape stays as it is to the bit.

`paper` (Car-Studio section V): a transparent colour over the photograph's car, of which only the texture code is
taken. `mix`: a part of another car's texture code. `paint`: the car is rendered from all sides, its paint is exchanged
in these pictures (`scene.paint`), and the texture code is fitted to them.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.dataset.patch import MaskValue, Patch
from carstudio.dataset.pixels import prepare_patch
from carstudio.errors import InputError
from carstudio.files import read_json
from carstudio.fitting.car_file import Car
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance
from carstudio.geometry.transforms import transform_points
from carstudio.images import read_image
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.rendering.rays import Rays, image_positions, image_rays
from carstudio.scene.graph import CarRef
from carstudio.scene.own_pictures import own_picture
from carstudio.scene.paint import PaintView, body_colour, paint_share, painted, parse_colour
from carstudio.scene.shelf import PATCH, PATCH_DESCRIPTION, PATCH_MASK, CarShelf
from carstudio.training.batches import generator_for, patch_batch, stack_boxes

Way = Literal["paint", "paper", "mix"]
Colour = tuple[float, float, float]
TRANSPARENCY = 0.5  # of the paper's colour mask: its figure shows shading through the colour, no number is given
_SOLID = 0.5  # opacity from which a pixel is on the car


@dataclass(frozen=True)
class PaintConfig:
    """How the texture code is fitted to painted pictures."""

    views: int = 8
    side_px: int = 64
    steps: int = 150
    rays: int = 1024
    rate: float = 0.03
    weight_rate: float = 0.15  # of a car's own colour weights
    seed: int = 0


def recolour_car(
    shelf: CarShelf,
    ref: CarRef,
    *,
    way: Way,
    colour: str | Colour | None = None,
    other: CarRef | None = None,
    amount: float | None = None,
    config: PaintConfig | None = None,
) -> CarRef:
    """The car in another colour, put on the shelf; the same request gives the same car (and does no work twice)."""
    asked: dict[str, Any] = {"from": [ref.name, ref.sha256], "way": way, "amount": amount}
    asked["colour"] = None if colour is None else list(parse_colour(colour))
    asked["config"] = None if config is None else asdict(config)
    asked["other"] = None if other is None else [other.name, other.sha256]
    checksum = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:12]
    name = f"{ref.name[:80]}-{checksum}"
    if name in shelf.names():
        return shelf.ref(name)
    car = shelf.load(ref)
    model = shelf.model_of(car)
    weights: dict[str, Tensor] = {}
    if way == "mix":
        assert other is not None
        amount = 1.0 if amount is None else amount
        texture = mixed_texture(car, shelf.load(other), amount)
        weights = mixed_weights(model, shelf.model_of(shelf.load(other)), car, amount)
    elif way == "paper":
        assert colour is not None
        texture = masked_texture(model, car, parse_colour(colour), shelf, ref, 1 - TRANSPARENCY)
    else:
        assert colour is not None
        texture, weights = painted_look(model, car, parse_colour(colour), config)
    new = replace(
        car,
        latents=Latents(car.latents.shape, texture),
        weights={**car.weights, **weights},
        provenance={**car.provenance, "recoloured": asked},
    )
    return shelf.add(new, name)


def mixed_texture(car: Car, other: Car, amount: float) -> Float[Tensor, "1 code"]:
    """`amount` of the other car's texture code; `InputError` when they are of different models."""
    if car.model_sha256 != other.model_sha256:
        raise InputError(
            f"textures of two models do not mix: {car.instance_id} is of {car.model_name}, {other.instance_id} of "
            f"{other.model_name}; fit both with one"
        )
    return torch.lerp(car.latents.texture, other.latents.texture, amount)


@torch.no_grad()
def mixed_weights(model: CategoryModel, other: CategoryModel, car: Car, amount: float) -> dict[str, Tensor]:
    """`amount` of the other car's own colour weights, where this car has some of its own."""
    theirs = dict(other.colour_parameters())
    mine = [(name, value) for name, value in model.colour_parameters() if name in car.weights]
    return {name: torch.lerp(value, theirs[name].to(value.device), amount).cpu() for name, value in mine}


@torch.no_grad()
def masked_texture(
    model: CategoryModel, car: Car, colour: Colour, shelf: CarShelf, ref: CarRef, opacity: float
) -> Float[Tensor, "1 code"]:
    """The texture code of the car's photograph with a transparent colour over its mask.

    A car without a photograph beside it (made elsewhere) is encoded from its own picture.
    """
    patch = _photograph(shelf, ref) or own_picture(model, car, azimuth_deg=35.0)
    on_car = patch.mask == MaskValue.CAR
    image = patch.image.copy()
    tint = torch.tensor(colour).numpy() * 255
    image[on_car] = (image[on_car] * (1 - opacity) + tint * opacity).round().astype(image.dtype)
    batch = patch_batch([prepare_patch(replace(patch, image=image), model.encoder_side_px)])
    return model.encode(batch.to(_device(model))).texture.float().cpu()


def _photograph(shelf: CarShelf, ref: CarRef) -> Patch | None:
    """The patch that lies beside a car."""
    folder = shelf.folder(ref.name)
    if not (folder / PATCH_DESCRIPTION).is_file():
        return None
    value = read_json(folder / PATCH_DESCRIPTION)
    image, mask = read_image(folder / PATCH), read_image(folder / PATCH_MASK, mode="L")
    try:
        camera = Camera(torch.tensor(value["intrinsics"]).float(), image.shape[1], image.shape[0])
        center, size, rotation = (
            torch.tensor(value[key]).float() for key in ("box_center", "box_size", "box_rotation")
        )
        box = Box3D(center, size, rotation)
        assert box.center.shape == (3,)
    except (KeyError, TypeError, ValueError, AssertionError) as error:
        raise InputError(f"{folder / PATCH_DESCRIPTION}: not a patch's camera and box; make the scene again") from error
    return Patch(ref.name, ref.name, image, mask, None, camera, box)


def around(car: Car, views: int, *, azimuth_deg: float = 0.0) -> list[Box3D]:
    """The car's box seen from sides spread evenly, by turns from a little and from more above."""
    size = torch.tensor(car.size)
    distance = orbit_distance(size)
    heights = (8.0, 25.0)
    return [
        orbit_box(size, azimuth_deg=azimuth_deg + 360 * i / views, elevation_deg=heights[i % 2], distance_m=distance)
        for i in range(views)
    ]


@dataclass(frozen=True)
class CarPictures:
    """A car seen from all sides: rays and boxes of the views, their pixels one after another."""

    rays: Rays
    box: Box3D
    pixels: PaintView
    opacity: Float[Tensor, " pixel"]


@torch.no_grad()
def pictures_of(model: CategoryModel, car: Car, config: PaintConfig) -> CarPictures:
    """Render the car from all sides and find where on it each pixel lies."""
    camera = orbit_camera(config.side_px)
    boxes = around(car, config.views)
    parts = []
    for box in boxes:
        found = render_image(
            model, camera.to(_device(model)), _latents(model, car), stack_boxes([box]).to(_device(model))
        )
        rgb, opacity, depth = (found[name].cpu().flatten(0, 1) for name in ("rgb", "opacity", "depth_m"))
        points = camera.unproject(image_positions(camera.width, camera.height, rgb), depth)
        place = transform_points(canonical_from_camera(box), points)
        parts.append((rgb / opacity.clamp(min=1e-3)[:, None], place, opacity > _SOLID, opacity))
    rgb, place, is_car, opacity = (torch.cat(part) for part in zip(*parts, strict=True))
    rays = image_rays(camera)
    many = Rays(*(value.expand(len(boxes), *value.shape[1:]) for value in (rays.origins, rays.directions, rays.radii)))
    return CarPictures(many, stack_boxes(boxes), PaintView(rgb.clamp(0, 1), place, is_car), opacity)


def painted_look(
    model: CategoryModel, car: Car, colour: Colour, config: PaintConfig | None = None
) -> tuple[Float[Tensor, "1 code"], dict[str, Tensor]]:
    """The texture code whose pictures come nearest to the car's own with the paint exchanged.

    A car with colour weights of its own gets other ones too: they hold its old paint. `model` is the car's own then,
    and is changed.
    """
    config = config or PaintConfig()
    pictures = pictures_of(model, car, config)
    paint = body_colour(pictures.pixels)
    share = paint_share(pictures.pixels, paint)
    wanted = painted(pictures.pixels.rgb, share, paint, colour) * pictures.opacity[:, None]
    wanted = wanted.view(config.views, -1, 3).to(_device(model))
    return _fit_look(model, car, pictures, wanted, config)


def _fit_look(
    model: CategoryModel, car: Car, pictures: CarPictures, wanted: Float[Tensor, "view ray 3"], config: PaintConfig
) -> tuple[Float[Tensor, "1 code"], dict[str, Tensor]]:
    device = _device(model)
    latents = _latents(model, car)
    texture = latents.texture.clone().requires_grad_()
    weights = {name: value for name, value in model.colour_parameters() if name in car.weights}
    moved = [texture, *weights.values()]
    groups = [{"params": [texture], "lr": config.rate}]
    if weights:
        groups.append({"params": list(weights.values()), "lr": config.weight_rate})
    optimizer = torch.optim.Adam(groups)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(config.steps, 1))
    rays, box = pictures.rays.to(device), pictures.box.to(device)
    solid = (pictures.opacity.view(config.views, -1) > 0.05).float()
    shape = latents.shape.expand(config.views, -1)
    for step in range(config.steps):
        picked = torch.multinomial(
            solid + 1e-6, config.rays // config.views, generator=generator_for(config.seed, step, "pixels")
        ).to(device)
        some = Rays(*(_rows(value, picked) for value in (rays.origins, rays.directions, rays.radii)))
        found = model.render_levels(some, Latents(shape, texture.expand(config.views, -1)), box)[-1]
        loss = ((found.rgb - _rows(wanted, picked)) ** 2).mean()
        for value, gradient in zip(moved, torch.autograd.grad(loss, moved), strict=True):
            value.grad = gradient
        optimizer.step()
        schedule.step()
    return texture.detach().cpu(), {name: value.detach().clone().cpu() for name, value in weights.items()}


def _rows(values: Tensor, picked: Tensor) -> Tensor:
    index = picked if values.dim() == 2 else picked[..., None].expand(*picked.shape, values.shape[-1])
    return values.gather(1, index)


def _latents(model: CategoryModel, car: Car) -> Latents:
    return Latents(car.latents.shape.to(_device(model)), car.latents.texture.to(_device(model)))


def _device(model: CategoryModel) -> torch.device:
    return next(model.parameters()).device
