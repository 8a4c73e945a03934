import dataclasses

import pytest
import torch

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.car_nerf import CarNeRF, CarNeRFConfig
from carstudio.models.encoders import EncoderConfig
from carstudio.models.interface import Latents, PatchBatch, render_image
from carstudio.models.patch_features import pose_features, tiny_masked_copy
from carstudio.recipes import car_nerf, car_nerf_small
from carstudio.rendering.field import SamplingConfig
from carstudio.rendering.rays import image_rays


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def small_model(**changes: object) -> CarNeRF:
    config = CarNeRFConfig(
        encoder=EncoderConfig(kind="small", side_px=32, pretrained=None, num_features=32),
        sampling=SamplingConfig(coarse=8, fine=8),
        width=32,
        depth=4,
        skip_after=2,
        code_size=16,
        **changes,  # type: ignore[arg-type]
    )
    torch.manual_seed(1)
    return CarNeRF(config).eval()


def batch(count: int = 2, side: int = 32) -> PatchBatch:
    generator = torch.Generator().manual_seed(0)
    boxes = [
        orbit_box(torch.tensor([4.2, 1.5, 1.8]), azimuth_deg=50.0 * i + 10, elevation_deg=8.0, distance_m=9.0)
        for i in range(count)
    ]
    box = Box3D(*(torch.stack([getattr(b, name) for b in boxes]) for name in ("center", "size", "rotation")))
    mask = torch.zeros(count, side, side)
    mask[:, 8:24, 4:28] = 1
    camera = Camera(orbit_camera(side).intrinsics.expand(count, 4), side, side)
    image = torch.rand(count, 3, side, side, generator=generator)
    return PatchBatch(image, mask, camera, box, tuple("abcdef"[:count]))


def test_parameter_counts_by_hand() -> None:
    """As released: 846,340 with the two 512 -> 128 maps (131,328), 715,012 without; summed layer by layer here."""
    model = CarNeRF(car_nerf().model)
    linear = lambda inside, outside: inside * outside + outside  # noqa: E731
    position_and_shape = linear(96, 256) + linear(128, 256)
    trunk = 2 * position_and_shape + 7 * linear(256, 256)
    colour = linear(256, 256) + linear(128, 256) + linear(24, 256) + linear(256, 128) + linear(128, 3)
    assert count(model.field) == trunk + linear(256, 1) + colour == 715_012
    assert count(model.shape_head) + count(model.texture_head) == 2 * linear(512, 128) == 131_328


def test_resnet_features_are_the_papers_512_and_follow_the_photo() -> None:
    torch.manual_seed(0)
    encoder = CarNeRF(car_nerf().model).encoder.eval()
    image = torch.rand(2, 3, 128, 128)
    patches = dataclasses.replace(batch(2), image=image, mask=torch.zeros(2, 128, 128))
    features = encoder(patches)
    assert features.shape == (2, 512)
    # the first 64 are the stem's maxima over the image: an independent computation
    stem = torch.relu(encoder.embedder.normalization(encoder.embedder.convolution((image - 0.5) / 0.5)))
    assert torch.allclose(features[:, :64], stem.flatten(2).amax(dim=-1), atol=1e-5)
    assert torch.allclose(
        encoder(dataclasses.replace(batch(1), image=image[:1], mask=patches.mask[:1]))[0], features[0], atol=1e-4
    )


def test_texture_leaves_density_bit_identical() -> None:
    model = small_model()
    with torch.no_grad():
        patches = batch(1)
        latents = model.encode(patches)
        recoloured = Latents(latents.shape, torch.randn_like(latents.texture) * 5)
        rays = image_rays(orbit_camera(16))
        a, b = (model.trace(rays, codes, patches.box) for codes in (latents, recoloured))
    assert torch.equal(a.alpha, b.alpha)
    assert torch.equal(a.distance_m, b.distance_m)
    assert not torch.allclose(a.rgb, b.rgb)


def test_shape_changes_density() -> None:
    model = small_model()
    with torch.no_grad():
        patches = batch(1)
        latents = model.encode(patches)
        rays = image_rays(orbit_camera(16))
        other = Latents(latents.shape + 3.0, latents.texture)
        assert not torch.allclose(
            model.trace(rays, latents, patches.box).alpha, model.trace(rays, other, patches.box).alpha
        )


@pytest.mark.parametrize("chunk", [1, 7, 100, 100_000])
def test_chunk_size_changes_no_pixel(chunk: int) -> None:
    model, patches = small_model(), batch(1)
    latents = model.encode(patches)
    camera = orbit_camera(24)
    whole = render_image(model, camera, latents, patches.box, chunk=576)
    parts = render_image(model, camera, latents, patches.box, chunk=chunk)
    for name, image in whole.items():
        # matrix products of other sizes round differently in the last bits
        assert torch.allclose(image, parts[name], atol=2e-6), name


def test_rendered_images_are_laid_out_row_by_row() -> None:
    """One pixel rendered through its own ray equals the image at (v, u)."""
    model, patches = small_model(), batch(1)
    latents = model.encode(patches)
    camera = orbit_camera(24)
    image = render_image(model, camera, latents, patches.box)
    u, v = 13, 9
    single = render_image(model, camera.crop(u, v, 1, 1), latents, patches.box)
    assert torch.allclose(image["rgb"][v, u], single["rgb"][0, 0], atol=1e-6)
    assert image["rgb"].shape == (24, 24, 3)
    assert float(image["opacity"][0, 0]) == 0.0


def test_cars_of_a_batch_do_not_mix() -> None:
    model, patches = small_model(), batch(3)
    with torch.no_grad():
        together = model.encode(patches)
        rays = image_rays(orbit_camera(12))
        three = type(rays)(*(getattr(rays, n).expand(3, *getattr(rays, n).shape[1:]) for n in rays.__annotations__))
        all_three = model.render(three, together, patches.box)
        for i in range(3):
            box = Box3D(patches.box.center[i : i + 1], patches.box.size[i : i + 1], patches.box.rotation[i : i + 1])
            alone = model.render(rays, together.select(i), box)
            assert torch.allclose(alone.rgb[0], all_three.rgb[i], atol=1e-5)


def test_gradients_reach_every_parameter_and_stay_finite() -> None:
    model = small_model(normalise_codes=True, colour_skip_px=4, encode_pose=True)
    patches = batch(2)
    rays = image_rays(orbit_camera(12))
    both = type(rays)(*(getattr(rays, n).expand(2, *getattr(rays, n).shape[1:]) for n in rays.__annotations__))
    found = model.render(both, model.encode(patches), patches.box)
    (found.rgb.sum() + found.opacity.sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        # LayerNorm's shape-independent parts aside, something flows everywhere
        assert float(parameter.grad.abs().max()) > 0, name


def test_tiny_copy_is_the_mean_of_the_cars_pixels() -> None:
    patches = batch(1)
    found = tiny_masked_copy(patches, 4).reshape(3, 4, 4)
    cell = patches.image[0, :, 8:16, 8:16]
    assert torch.allclose(found[:, 1, 1], cell.mean(dim=(1, 2)), atol=1e-6)  # wholly car
    assert float(found[:, 0, 0].abs().max()) == 0.0  # no car
    half = patches.image[0, :, 8:16, 4:8]
    assert torch.allclose(found[:, 1, 0], half.mean(dim=(1, 2)), atol=1e-6)  # half car: mean of the car's half


def test_pose_features_know_the_azimuth_and_not_the_distance() -> None:
    def features(azimuth_deg: float, distance_m: float) -> torch.Tensor:
        box = orbit_box(
            torch.tensor([4.2, 1.55, 1.8]), azimuth_deg=azimuth_deg, elevation_deg=5.0, distance_m=distance_m
        )
        patches = batch(1)
        one = Box3D(box.center[None], box.size[None], box.rotation[None])
        return pose_features(PatchBatch(patches.image, patches.mask, patches.camera, one, ("a",)))[0]

    assert torch.allclose(features(30.0, 8.0), features(30.0, 20.0), atol=1e-6)
    assert not torch.allclose(features(30.0, 8.0), features(60.0, 8.0), atol=0.1)
    assert torch.allclose(features(30.0, 8.0)[9:], torch.zeros(3), atol=1e-6)


def test_the_small_recipe_builds_and_renders() -> None:
    torch.manual_seed(0)
    model = CarNeRF(car_nerf_small().model).eval()
    patches = batch(1, side=64)
    image = render_image(model, orbit_camera(16), model.encode(patches), patches.box)
    assert bool(torch.isfinite(image["rgb"]).all())
    assert 0.0 <= float(image["rgb"].min())
    assert float(image["rgb"].max()) <= 1.0 + 1e-5


def test_weights_too_large_for_any_picture_are_told() -> None:
    """Finite weights can still overflow on their way to a pixel."""
    torch.manual_seed(0)
    model = small_model()
    with torch.no_grad():
        for parameter in model.field.parameters():
            parameter.mul_(1e30)
    box = orbit_box(torch.tensor([4.0, 1.5, 1.8]), azimuth_deg=40.0, elevation_deg=10.0, distance_m=9.0)
    batch = Box3D(box.center[None], box.size[None], box.rotation[None])
    latents = Latents(torch.ones(1, 16), torch.ones(1, 16))
    with pytest.raises(InputError, match="not made of finite numbers: its weights are damaged"):
        render_image(model, orbit_camera(4), latents, batch)
