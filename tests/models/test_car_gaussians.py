"""The Gaussian model: what codes may change, where the photo is looked up, symmetry, training and files."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.protocols import EvaluationConfig, score_views, view_pairs
from carstudio.geometry.box3d import Box3D, mirror_box
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.car_gaussians import CarGaussians, CarGaussiansConfig, brightness_logit, exchanged
from carstudio.models.encoders import EncoderConfig
from carstudio.models.gaussian_template import EXTENT, surface_template
from carstudio.models.interface import CategoryModel, Latents, PatchBatch, render_image, window_of
from carstudio.models.left_views import as_left_views
from carstudio.models.zoo import config_from_json, config_to_json
from carstudio.recipes import RECIPES, recipe
from carstudio.rendering.gaussians.projection import bake_cloud
from carstudio.rendering.rays import image_rays, to_canonical
from carstudio.rendering.volume import composite
from carstudio.training.checkpoint import load_model, save_model
from carstudio.training.log import read_log
from carstudio.training.schedule import ScheduleConfig
from carstudio.training.trainer import train
from training.toy import TINY, toy_store

SMALL = CarGaussiansConfig(
    encoder=EncoderConfig(kind="small", side_px=32, pretrained=None, num_features=32, sees_mask=True),
    num_splats=64,
    code_size=16,
    width=32,
    tint_width=8,
    colour_skip_px=4,
)


def small_model(**changes: object) -> CarGaussians:
    torch.manual_seed(1)
    return CarGaussians(dataclasses.replace(SMALL, **changes)).eval()  # type: ignore[arg-type]


def batch(count: int = 1, side: int = 32) -> PatchBatch:
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([4.2, 1.5, 1.8])
    boxes = [orbit_box(size, azimuth_deg=50.0 * i + 10, elevation_deg=8.0, distance_m=9.0) for i in range(count)]
    box = Box3D(*(torch.stack([getattr(b, name) for b in boxes]) for name in ("center", "size", "rotation")))
    mask = torch.zeros(count, side, side)
    mask[:, side // 4 : -side // 4, side // 8 : -side // 8] = 1
    camera = Camera(orbit_camera(side).intrinsics.expand(count, 4), side, side)
    image = torch.rand(count, 3, side, side, generator=generator)
    return PatchBatch(image, mask, camera, box, tuple("abcdef"[:count]))


@torch.no_grad()
def test_recolouring_keeps_the_shape_to_the_bit() -> None:
    model, patches = small_model(), batch()
    latents = model.encode(patches)
    recoloured = Latents(latents.shape, torch.randn_like(latents.texture))
    rays = image_rays(orbit_camera(16))
    a, b = (model.trace(rays, codes, patches.box) for codes in (latents, recoloured))
    assert torch.equal(a.alpha, b.alpha)
    assert torch.equal(a.distance_m, b.distance_m)
    assert not torch.allclose(a.rgb, b.rgb)


def test_colour_errors_do_not_bend_the_shape() -> None:
    model, patches = small_model(), batch()
    model.decode(model.encode(patches)).rgb.sum().backward()
    assert model.shape_head.weight.grad is None
    assert all(parameter.grad is None for parameter in model.geometry.parameters())
    assert model.texture_head.weight.grad is not None


def test_every_weight_learns() -> None:
    """All but the first layer of the tint at the first step: the second one starts at zero."""
    model, patches = small_model().train(), batch(3)
    rays = image_rays(orbit_camera(12))
    rays = dataclasses.replace(rays, **{k: v.expand(3, *v.shape[1:]) for k, v in vars(rays).items()})
    rendered = model.render_levels(rays, model.encode(patches), patches.box)[-1]
    (rendered.rgb.square().sum() + rendered.opacity.square().sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert name.startswith("colour.tint.0") or float(parameter.grad.abs().max()) > 0, name


@torch.no_grad()
@pytest.mark.parametrize("chunk", [48, 1000, 100_000])
def test_images_are_the_composite_of_the_segments_whatever_the_chunk(chunk: int) -> None:
    model, patches = small_model(), batch()
    latents, camera = model.encode(patches), orbit_camera(30)
    image = render_image(model, camera, latents, patches.box, chunk=chunk)
    plain = composite(model.trace(image_rays(camera), latents, patches.box))
    assert torch.allclose(image["rgb"].flatten(0, 1), plain.rgb[0], atol=1e-4)
    assert torch.allclose(image["opacity"].flatten(), plain.opacity[0], atol=1e-4)
    seen = plain.opacity[0] > 0.1
    assert float((image["depth_m"].flatten() - plain.depth_m[0])[seen].abs().max()) < 2e-3


@torch.no_grad()
def test_a_car_is_symmetric_where_the_config_says_so() -> None:
    cloud = small_model().decode(small_model().encode(batch()))
    half = SMALL.num_splats // 2
    mirrored = cloud.mirrored()
    assert torch.equal(cloud.mean[:, half:], mirrored.mean[:, :half])
    assert torch.allclose(cloud.covariance().matrix()[:, half:], mirrored.covariance().matrix()[:, :half], atol=1e-7)
    lone = small_model(is_symmetric=False)
    assert lone.decode(lone.encode(batch())).mean.shape == (1, 64, 3)


def test_the_template_covers_the_box_on_both_sides() -> None:
    for is_half in (False, True):
        template = surface_template(200, is_half=is_half)
        assert float(template.mean.abs().max()) <= EXTENT + 1e-6
        assert float(template.mean.abs().amax(dim=-1).min()) > 0.6  # on the surface, not inside
        assert bool((template.mean[:, 2] > 0).all()) is is_half


TOY = dataclasses.replace(TINY, recipe="toy-gaussians", model=SMALL, mirroring="apart", rays_per_patch=128)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store")


def test_it_learns_the_toy_cars(store: PatchStore, tmp_path: Path) -> None:
    """As the same test of Car-NeRF: silhouettes overlap well, novel views beat a grey car (13 dB) by far."""
    train(dataclasses.replace(TOY, steps=200), store, tmp_path / "run", device="cpu")
    model = load_model(tmp_path / "run")
    views = list(score_views(model, store, view_pairs(store, EvaluationConfig(protocol="novel-view", split=None))))
    assert sum(view.scores.mask_iou or 0 for view in views) / len(views) > 0.85
    assert sum(view.scores.psnr or 0 for view in views) / len(views) > 17.0


def test_4096_gaussians_learn_too(store: PatchStore, tmp_path: Path) -> None:
    """Eight times the recipe's number: the loss falls, everything stays finite, a picture comes out."""
    model = dataclasses.replace(SMALL, num_splats=4096)
    rate = ScheduleConfig(first=5e-3, last=1e-3, decay_steps=None)
    config = dataclasses.replace(TOY, model=model, schedule=rate, steps=30, save_every=30, log_every=5)
    train(config, store, tmp_path / "run", device="cpu")
    losses = [row["loss"] for row in read_log(tmp_path / "run" / "log.jsonl")]
    assert all(math.isfinite(loss) for loss in losses)
    assert losses[-1] < 0.9 * losses[0], losses
    trained = load_model(tmp_path / "run")
    assert all(bool(parameter.isfinite().all()) for parameter in trained.parameters())
    patches = batch(1, side=trained.encoder_side_px)
    with torch.no_grad():
        image = render_image(trained, orbit_camera(32), trained.encode(patches), patches.box)
    assert float(image["opacity"].max()) > 0.9


class KilledError(Exception):
    """Stands for SIGKILL right after a checkpoint."""


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(store: PatchStore, tmp_path: Path) -> None:
    def kill(model: CategoryModel, step: int) -> None:
        if step == 8:
            raise KilledError

    torch.set_num_threads(1)
    train(TOY, store, tmp_path / "whole", device="cpu")
    with pytest.raises(KilledError):
        train(TOY, store, tmp_path / "parts", device="cpu", on_save=kill)
    train(TOY, store, tmp_path / "parts", device="cpu", resume=True)
    for name in ("model.safetensors", "log.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


@torch.no_grad()
def test_a_saved_model_comes_back(tmp_path: Path) -> None:
    model, patches = small_model(), batch()
    save_model(tmp_path, model, model.config, {})
    again = load_model(tmp_path)
    camera = orbit_camera(16)
    a, b = (render_image(m, camera, m.encode(patches), patches.box)["rgb"] for m in (model, again))
    assert torch.equal(a, b)


@torch.no_grad()
@pytest.mark.parametrize("name", [name for name in RECIPES if "gaussians" in name])
def test_the_recipes_build_and_render(name: str) -> None:
    torch.manual_seed(0)
    model = CarGaussians(recipe(name).model).eval()  # type: ignore[arg-type]
    patches = batch(1, side=model.encoder_side_px)
    image = render_image(model, orbit_camera(16), model.encode(patches), patches.box)
    assert bool(torch.isfinite(image["rgb"]).all())
    assert 0.0 <= float(image["rgb"].min())
    assert float(image["rgb"].max()) <= 1.0 + 1e-5
    assert float(image["opacity"].max()) > 0.5


def test_a_damaged_description_is_refused() -> None:
    value = config_to_json(SMALL)
    assert config_from_json(value, name="model.json") == SMALL
    for change in ({"num_splats": 63}, {"least_scale": 0.0}, {"splatting": {"most": "many"}}, {"wings": 2}):
        with pytest.raises(InputError, match=r"model\.json"):
            config_from_json({**value, **change}, name="model.json")


@pytest.mark.parametrize("azimuth_deg", [0.0, 33.0, 90.0])
@pytest.mark.parametrize("distance_m", [1.0, 5.0, 30.0])
@pytest.mark.parametrize("shift_px", [-90.0, 0.0, 25.0])
def test_no_ray_outside_of_the_window_hits_the_box(azimuth_deg: float, distance_m: float, shift_px: float) -> None:
    size = torch.tensor([4.2, 1.55, 1.8])
    placed = orbit_box(size, azimuth_deg=azimuth_deg, elevation_deg=20.0, distance_m=distance_m)
    box = Box3D(placed.center[None], placed.size[None], placed.rotation[None])
    straight = orbit_camera(64)
    camera = Camera(straight.intrinsics + torch.tensor([0.0, 0.0, shift_px, 0.0]), 64, 64)
    hit = to_canonical(image_rays(camera), box).hit.view(64, 64)
    x, y, width, height = window_of(box, camera)
    assert 0 <= x <= x + width <= 64
    assert 0 <= y <= y + height <= 64
    hit[y : y + height, x : x + width] = False
    assert not bool(hit.any())
    if distance_m == 30.0:
        assert width * height < 64 * 64 / 4


@torch.no_grad()
def test_a_car_out_of_sight_gives_an_empty_picture() -> None:
    model, patches = small_model(), batch()
    aside = Box3D(patches.box.center + torch.tensor([60.0, 0.0, 0.0]), patches.box.size, patches.box.rotation)
    image = render_image(model, orbit_camera(16), model.encode(patches), aside)
    assert image["rgb"].shape == (16, 16, 3)
    assert float(image["opacity"].max()) == 0.0


@torch.no_grad()
def test_reduced_precision_ends_at_the_codes() -> None:
    model, patches = small_model(), batch()
    rays = image_rays(orbit_camera(16))
    latents = model.encode(patches)
    plain = model.render(rays, latents, patches.box)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        reduced = model.render(rays, latents, patches.box)
    assert torch.equal(plain.rgb, reduced.rgb)
    assert torch.equal(plain.opacity, reduced.opacity)


LEFT = dataclasses.replace(SMALL, encodes_left_views=True, starts_from_brightness=True, has_light=True)


def mirrored(patches: PatchBatch) -> PatchBatch:
    """The photos flipped left to right, of the mirrored cars."""
    return PatchBatch(
        patches.image.flip(3),
        patches.mask.flip(2),
        patches.camera.flip(),
        mirror_box(patches.box),
        patches.instance_ids,
    )


def aside(count: int) -> PatchBatch:
    """Photos of cars beside the middle, by a camera whose principal point is beside it too."""
    patches = batch(count)
    box = dataclasses.replace(patches.box, center=patches.box.center + torch.tensor([0.6, 0.1, 0.0]))
    intrinsics = patches.camera.intrinsics + torch.tensor([0.0, 0.0, 1.5, 0.0])
    return dataclasses.replace(patches, box=box, camera=dataclasses.replace(patches.camera, intrinsics=intrinsics))


def moved_model() -> CarGaussians:
    """One whose colours are tinted and whose Gaussians depend on the photo, unlike before the first step."""
    torch.manual_seed(1)
    model = CarGaussians(LEFT).eval()
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.1)
    return model


def test_left_views_are_the_photos_of_the_left_and_the_mirror_images_of_the_others() -> None:
    patches = aside(6)  # azimuths 10 to 260 degrees
    turned, side = as_left_views(patches)
    eye = canonical_from_camera(patches.box)[:, 2, 3]
    assert side.tolist() == eye.sign().tolist()
    assert 0 < int((side > 0).sum()) < 6
    assert bool((canonical_from_camera(turned.box)[:, 2, 3] > 0).all())
    other = mirrored(patches)
    for row, where in enumerate(side.tolist()):
        expected = patches if where > 0 else other
        assert torch.equal(turned.image[row], expected.image[row])
        assert torch.equal(turned.mask[row], expected.mask[row])
        assert torch.equal(turned.camera.intrinsics[row], expected.camera.intrinsics[row])
        for name in ("center", "size", "rotation"):
            assert torch.equal(getattr(turned.box, name)[row], getattr(expected.box, name)[row])


@torch.no_grad()
def test_a_mirrored_photo_gives_the_mirrored_car() -> None:
    """Codes are the same but for the side, and pictures are each other's mirror images, tint and all."""
    model, patches = moved_model(), aside(6)
    own, other = model.encode(patches), model.encode(mirrored(patches))
    assert torch.allclose(own.shape, other.shape, atol=1e-6)
    assert own.texture.shape == (6, LEFT.texture_size) == (6, SMALL.code_size + 2)
    same, side = [*range(SMALL.code_size), SMALL.code_size + 1], SMALL.code_size
    assert torch.allclose(own.texture[:, same], other.texture[:, same], atol=1e-6)
    assert torch.equal(own.texture[:, side], -other.texture[:, side])
    assert sorted(set(own.texture[:, side].tolist())) == [-1, 1]
    half = SMALL.num_splats // 2
    for row in range(6):
        clouds = model.decode(own.select(row)), model.decode(other.select(row))
        assert not torch.allclose(clouds[0].rgb[:, :half], clouds[0].rgb[:, half:], atol=1e-3)
        camera, box = orbit_camera(40), patches.box.select(slice(row, row + 1))
        turned = orbit_box(box.size[0], azimuth_deg=75.0, elevation_deg=20.0, distance_m=8.0)
        turned = Box3D(turned.center[None], turned.size[None], turned.rotation[None])
        picture = render_image(model, camera, own.select(row), turned)
        mirror = render_image(model, camera.flip(), other.select(row), mirror_box(turned))
        for name in ("rgb", "opacity", "depth_m"):
            assert torch.allclose(picture[name], mirror[name].flip(1), atol=2e-4), name


def test_between_the_sides_colours_are_mixed() -> None:
    rgb, tint = torch.rand(1, 8, 3), torch.randn(1, 8, 3, 3)
    light = torch.randn(1, 9, 3)
    left, right, middle = (exchanged(rgb, tint, light, torch.tensor([side])) for side in (1.0, -1.0, 0.0))
    assert torch.equal(left[0], rgb)
    assert left[1] is not None
    assert right[1] is not None
    assert torch.equal(left[1], tint)
    assert torch.equal(right[0][:, :4], rgb[:, 4:])
    assert torch.equal(right[1][:, 4:], tint[:, :4] * torch.tensor([1.0, 1.0, -1.0]))
    assert torch.allclose(middle[0], (left[0] + right[0]) / 2)
    beyond = exchanged(
        torch.tensor([[[0.0, 0.5, 1.0]], [[1.0, 0.5, 0.0]]]).transpose(0, 1), None, None, torch.ones(1) * 3
    )
    assert beyond[0].tolist() == [[[0.0, 0.5, 1.0], [1.0, 0.5, 0.0]]]
    assert left[2] is not None
    assert torch.equal(left[2], light)
    assert exchanged(rgb, None, None, torch.ones(1))[1:] == (None, None)
    with pytest.raises(AssertionError, match="mirrored pairs"):
        dataclasses.replace(LEFT, is_symmetric=False)


def test_colours_start_from_the_brightness_of_the_photographed_car() -> None:
    patches = batch(2)
    patches.image[0][:, patches.mask[0] == 1] = torch.tensor([[0.1], [0.2], [0.6]])
    patches.mask[1] = 0
    assert torch.allclose(brightness_logit(patches), torch.tensor([math.log(0.3 / 0.7), 0.0]), atol=1e-6)
    model = CarGaussians(LEFT)
    shape, code = torch.zeros(2, 1, LEFT.code_size)
    grey = [model.decode(Latents(shape, torch.cat([code, torch.tensor([[1, level]])], dim=1))).rgb for level in (0, 2)]
    assert torch.allclose(torch.logit(grey[1]) - torch.logit(grey[0]), torch.full_like(grey[0], 2.0), atol=1e-4)


@torch.no_grad()
def test_light_is_a_factor_by_the_side_the_camera_is_on() -> None:
    """Against the harmonics written out for a few directions, near and far, mirrored and baked."""
    model = moved_model()
    cloud = model.decode(model.encode(batch()))
    assert cloud.light is not None
    dark = dataclasses.replace(cloud, light=None, tint=None, rgb=cloud.rgb * 0.3)
    light = cloud.light * 0.3
    for eye, terms in (
        ((5.0, 0.0, 0.0), (1, 1, 0, 0, 0, 0, 0, 1, -1)),
        ((0.0, 2.0, 0.0), (1, 0, 1, 0, 0, 0, 0, 0, 2)),
        ((0.0, 3.0, -4.0), (1, 0, 0.6, -0.8, 0, 0, -0.48, -0.64, 0.08)),
    ):
        factor = torch.exp((torch.tensor(terms)[:, None] * light[0]).sum(dim=0))
        lit = dataclasses.replace(dark, light=light).colour_from(torch.tensor([eye]))
        assert torch.allclose(lit, (dark.rgb * factor).clamp(max=1), atol=1e-5)
        assert torch.allclose(
            lit, dataclasses.replace(dark, light=light).colour_from(torch.tensor([eye]) * 3), atol=1e-6
        )
        again = (
            dataclasses.replace(cloud, light=light)
            .mirrored()
            .colour_from(torch.tensor([eye]) * torch.tensor([1, 1, -1]))
        )
        assert torch.allclose(
            again, dataclasses.replace(cloud, light=light).colour_from(torch.tensor([eye])), atol=1e-5
        )
        baked = bake_cloud(dataclasses.replace(cloud, light=light)).colour_from(np.array(eye, np.float32))
        assert np.allclose(
            baked, dataclasses.replace(cloud, light=light).colour_from(torch.tensor([eye]))[0].numpy(), atol=1e-5
        )
