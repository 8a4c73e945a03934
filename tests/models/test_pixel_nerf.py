import math

import pytest
import torch

from carstudio.errors import InputError
from carstudio.fitting.optimise import FitConfig, fit
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.encoders import SMALL_PYRAMID_FEATURES, EncoderConfig, SmallPyramid
from carstudio.models.interface import Latents, PatchBatch, PixelFeatures
from carstudio.models.pixel_nerf import PixelNeRF, PixelNeRFConfig, look_up
from carstudio.recipes import pixelnerf_mlp, pixelnerf_resnet
from carstudio.rendering.field import SamplingConfig
from carstudio.rendering.rays import Rays, image_rays

SMALL = EncoderConfig(kind="small-pyramid", side_px=32, pretrained=None, num_features=SMALL_PYRAMID_FEATURES)
SIDE = 32


def count(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def linear(inside: int, outside: int) -> int:
    return inside * outside + outside


def boxes(number: int) -> Box3D:
    size = torch.tensor([4.2, 1.5, 1.8])
    each = [orbit_box(size, azimuth_deg=70.0 * i + 20, elevation_deg=8.0, distance_m=9.0) for i in range(number)]
    return Box3D(*(torch.stack([getattr(box, name) for box in each]) for name in ("center", "size", "rotation")))


def patches(number: int = 2) -> PatchBatch:
    camera = Camera(orbit_camera(SIDE).intrinsics.expand(number, 4), SIDE, SIDE)
    image = torch.rand(number, 3, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    return PatchBatch(image, torch.ones(number, SIDE, SIDE), camera, boxes(number), tuple("abcd"[:number]))


def features(rows: int, columns: int, channels: int = 3) -> PixelFeatures:
    """A map of another resolution than its camera's image, and not square."""
    generator = torch.Generator().manual_seed(1)
    camera = Camera(torch.tensor([[60.0, 50.0, 17.0, 11.0], [45.0, 55.0, 14.0, 13.0]]), 36, 24)
    return PixelFeatures(torch.randn(2, channels, rows, columns, generator=generator), camera, boxes(2))


def slow_look_up(pixels: PixelFeatures, points: torch.Tensor) -> torch.Tensor:
    """One point and one channel at a time, in Python's floats: pixel (i, j) of the map has its centre at +0.5."""
    found = torch.zeros(*points.shape[:3], pixels.map.shape[1])
    _, channels, rows, columns = pixels.map.shape
    for b in range(points.shape[0]):
        box = pixels.box.select(slice(b, b + 1))
        size, center, rotation = (part[0].tolist() for part in (box.size, box.center, box.rotation))
        fx, fy, cx, cy = pixels.camera.intrinsics[b].tolist()
        for r in range(points.shape[1]):
            for s in range(points.shape[2]):
                local = [value * side / 2 for value, side in zip(points[b, r, s].tolist(), size, strict=True)]
                x, y, z = (sum(rotation[i][j] * local[j] for j in range(3)) + center[i] for i in range(3))
                u = (fx * x / z + cx) / pixels.camera.width * columns - 0.5
                v = (fy * y / z + cy) / pixels.camera.height * rows - 0.5
                for c in range(channels):
                    total = 0.0
                    for i in (math.floor(v), math.floor(v) + 1):
                        for j in (math.floor(u), math.floor(u) + 1):
                            weight = (1 - abs(v - i)) * (1 - abs(u - j))
                            inside = pixels.map[b, c, min(max(i, 0), rows - 1), min(max(j, 0), columns - 1)]
                            total += weight * float(inside)
                    found[b, r, s, c] = total
    return found


def test_features_are_those_of_a_slow_loop() -> None:
    pixels = features(rows=12, columns=9)
    points = torch.rand(2, 5, 4, 3, generator=torch.Generator().manual_seed(2)) * 2 - 1
    assert torch.allclose(look_up(pixels, points), slow_look_up(pixels, points), atol=1e-5)


def test_a_map_of_positions_gives_back_where_points_project_to() -> None:
    """The map holds the image position of each of its pixels' centres, so bilinear look-up is projection itself."""
    pixels = features(rows=24, columns=36)
    v, u = torch.meshgrid(torch.arange(24) + 0.5, torch.arange(36) + 0.5, indexing="ij")
    ramp = PixelFeatures(torch.stack([u, v])[None].expand(2, 2, 24, 36).contiguous(), pixels.camera, pixels.box)
    points = (torch.rand(2, 6, 3, 3, generator=torch.Generator().manual_seed(3)) - 0.5) * 0.4  # well inside the image
    in_car = points.flatten(1, 2) * pixels.box.size[:, None] / 2
    in_camera = in_car @ pixels.box.rotation.mT + pixels.box.center[:, None]
    expected = pixels.camera.project(in_camera).unflatten(1, (6, 3))
    assert torch.allclose(look_up(ramp, points), expected, atol=1e-3)


def test_points_behind_the_camera_and_beyond_the_photo_are_finite() -> None:
    pixels = features(rows=6, columns=9)
    near = Box3D(pixels.box.center * 0.1, pixels.box.size, pixels.box.rotation)
    points = torch.rand(2, 5, 4, 3) * 2 - 1
    found = look_up(PixelFeatures(pixels.map.requires_grad_(), pixels.camera, near), points.requires_grad_())
    found.sum().backward()
    assert bool(torch.isfinite(found).all())
    assert points.grad is not None
    assert bool(torch.isfinite(points.grad).all())


def test_parameter_counts_by_hand() -> None:
    """Layer by layer: PixelNeRF's 42 inputs, five blocks of two layers, features before the first three; NeRF's MLP."""
    with torch.device("meta"):
        resnet, mlp = PixelNeRF(pixelnerf_resnet().model), PixelNeRF(pixelnerf_mlp().model)
    position = 3 + 6 * 6 + 3
    blocks = 5 * 2 * linear(512, 512) + 3 * linear(512, 512)
    assert count(resnet.field) == linear(position, 512) + blocks + linear(512, 4) == 3_438_596
    into = 3 + 6 * 10 + 512
    trunk = linear(into, 256) + 6 * linear(256, 256) + linear(256 + into, 256)
    colour = linear(256, 256) + linear(256 + 27, 128) + linear(128, 3)
    assert count(mlp.field) == trunk + linear(256, 1) + colour == 857_988


def model(**changes: object) -> PixelNeRF:
    torch.manual_seed(1)
    config = PixelNeRFConfig(encoder=SMALL, sampling=SamplingConfig(8, 0), width=32, depth=3, **changes)  # type: ignore[arg-type]
    return PixelNeRF(config).eval()


def two_views(rays: Rays) -> Rays:
    return Rays(*(getattr(rays, name).expand(2, *getattr(rays, name).shape[1:]) for name in rays.__annotations__))


@pytest.mark.parametrize("backbone", ["resnet", "mlp"])
def test_gradients_reach_every_parameter_through_the_map(backbone: str) -> None:
    net, batch = model(backbone=backbone, density="softplus"), patches()
    for layer in getattr(net.field, "second", []):
        torch.nn.init.normal_(layer.weight, std=0.1)  # the zeros they begin with let nothing through
    found = net.render(two_views(image_rays(orbit_camera(12))), net.encode(batch), batch.box)
    (found.rgb.sum() + found.opacity.sum()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert bool(torch.isfinite(parameter.grad).all()), name
        assert float(parameter.grad.abs().max()) > 0, name


def test_what_is_looked_up_moves_with_the_car() -> None:
    """The photo's box tells where a canonical point was, the box drawn where it is now: these two need not agree."""
    net, batch = model(density="softplus"), patches(1)
    with torch.no_grad():
        latents = net.encode(batch)
        rays = image_rays(orbit_camera(12))
        here = net.render(rays, latents, batch.box)
        shift = torch.tensor([0.5, -0.2, 3.0])
        moved = Rays(rays.origins + shift, rays.directions, rays.radii)
        there = net.render(moved, latents, Box3D(batch.box.center + shift, batch.box.size, batch.box.rotation))
    assert torch.allclose(here.rgb, there.rgb, atol=1e-4)


def test_cars_of_a_batch_do_not_mix_and_select_takes_their_pixels() -> None:
    net, batch = model(density="softplus"), patches(2)
    with torch.no_grad():
        together = net.encode(batch)
        rays = image_rays(orbit_camera(12))
        both = net.render(two_views(rays), together, batch.box)
        for i in range(2):
            alone = net.render(rays, together.select(i), batch.box.select(slice(i, i + 1)))
            assert torch.allclose(alone.rgb[0], both.rgb[i], atol=1e-5)


def test_a_global_latent_is_the_maps_maximum_and_the_same_everywhere() -> None:
    net, batch = model(features="global"), patches(2)
    with torch.no_grad():
        latents = net.encode(batch)
        assert latents.pixels is None
        assert torch.equal(latents.shape, net.encoder.feature_map(batch.image).flatten(2).amax(dim=-1))
        changed = Latents(latents.shape + 1.0, latents.texture)
        rays = two_views(image_rays(orbit_camera(8)))
        assert not torch.allclose(net.render(rays, latents, batch.box).rgb, net.render(rays, changed, batch.box).rgb)


def test_the_small_pyramid_keeps_where_things_are() -> None:
    """A bright spot in the photo is strongest in the map where it is: at half the resolution."""
    torch.manual_seed(0)
    pyramid = SmallPyramid().eval()
    dark = torch.zeros(1, 3, 32, 32)
    spot = dark.clone()
    spot[..., 20:22, 8:10] = 1.0
    change = (pyramid.feature_map(spot) - pyramid.feature_map(dark))[0, :32].abs().sum(dim=0)
    assert change.shape == (16, 16)
    row, column = divmod(int(change.argmax()), 16)
    assert (row, column) in {(10, 4), (10, 5), (11, 4), (11, 5)}


def test_a_model_without_codes_is_not_fitted() -> None:
    def never(*arguments: object) -> None:
        raise AssertionError("nothing is drawn")

    with pytest.raises(InputError, match="no codes to fit"):
        fit(model(), Latents(torch.zeros(1, 0), torch.zeros(1, 0)), never, never, FitConfig())  # type: ignore[arg-type]
