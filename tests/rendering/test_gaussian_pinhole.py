"""Whole pictures of Gaussians against the same ray by ray, traced the fast and the plain way."""

import numpy as np
import pytest
import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.transforms import rotation_y
from carstudio.rendering.gaussians import screen_tiles
from carstudio.rendering.gaussians.cloud import GaussianCloud
from carstudio.rendering.gaussians.pinhole import _Seen, draw_exactly
from carstudio.rendering.gaussians.projection import bake_cloud, project
from carstudio.rendering.gaussians.reference import FAINTEST, MAX_ALPHA
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud
from carstudio.rendering.rays import image_rays, to_canonical
from rendering.gaussian_scenes import car_box, random_cloud, surface_cloud

WIDE = Camera(torch.tensor([110.0, 130.0, 60.0, 31.0]), 97, 75)  # a short focal length: rays are far from parallel


def leaning_discs() -> GaussianCloud:
    cloud = random_cloud(40)
    wide = torch.tensor([0.3, 0.25, 0.01], dtype=torch.float64).log()
    return GaussianCloud(cloud.mean * 0.5, wide.expand(1, 40, 3), cloud.quaternion, cloud.opacity * 0.6, cloud.rgb)


def drawn(cloud: GaussianCloud, camera: Camera, box: Box3D, config: SplattingConfig) -> torch.Tensor | None:
    seen = project(bake_cloud(cloud), camera, box, widen=config.widen)
    image = draw_exactly(seen, camera.width, camera.height, most=config.most)
    return None if image is None else torch.from_numpy(image)


def traced(
    cloud: GaussianCloud, camera: Camera, box: Box3D, config: SplattingConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """The same picture ray by ray in double precision, and which rays hit the box."""
    rays = image_rays(Camera(camera.intrinsics.double(), camera.width, camera.height))
    canonical = to_canonical(rays, box)
    found = render_cloud(cloud, rays, canonical, config)
    parts = [found.rgb[0], found.opacity[0, :, None], found.depth_m[0, :, None]]
    return torch.cat(parts, dim=-1).view(camera.height, camera.width, 5), canonical.hit.view(camera.height, -1)


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * (a - b).square().mean().log10())


def turned(box: Box3D, radians: float, center: list[float]) -> Box3D:
    turn = rotation_y(torch.tensor(radians, dtype=torch.float64))
    return Box3D(torch.tensor([center], dtype=torch.float64), box.size, turn @ box.rotation)


@pytest.mark.parametrize("is_reference", [False, True])
@pytest.mark.parametrize(
    ("radians", "center"), [(0.0, [0.0, 0.3, 9.0]), (0.7, [1.5, 0.8, 6.5]), (2.9, [-2.5, -0.5, 8.0])]
)
def test_a_picture_is_what_its_rays_give(radians: float, center: list[float], is_reference: bool) -> None:
    """Off the middle of the picture and turned, where ellipses alone (`screen`) would be wrong."""
    config = SplattingConfig(most=600 if is_reference else 32, is_reference=is_reference)
    for cloud in (surface_cloud(), random_cloud(60)):
        box = turned(car_box(), radians, center)
        image, (truth, hit) = drawn(cloud, WIDE, box, config), traced(cloud, WIDE, box, config)
        assert image is not None
        assert int(hit.sum()) > 300
        assert psnr(image[hit][:, :4], truth[hit][:, :4]) > 65
        assert float((image - truth)[hit][:, :4].abs().max()) < 2 * FAINTEST  # of an alpha at the edge of what counts
        solid = hit & (truth[..., 3] > 0.5)
        assert float((image - truth)[solid][:, 4].abs().max()) < 0.05
        aside = Camera(WIDE.intrinsics + torch.tensor([0.5, 0.0, 0.5, 0.0]), WIDE.width, WIDE.height)
        moved = drawn(cloud, aside, box, config)
        assert moved is not None
        assert psnr(moved[hit][:, :4], truth[hit][:, :4]) < 45


@pytest.mark.parametrize("most", [1, 3, 8])
def test_the_first_hits_count_alone_and_in_the_order_of_each_ray(most: int) -> None:
    """Peaks of discs seen edge on lie far before the camera on rays that miss them; such rays count nothing."""
    for cloud in (surface_cloud(), leaning_discs()):
        box, config = turned(car_box(), 0.4, [0.5, 0.2, 7.0]), SplattingConfig(most=most)
        image, (truth, hit) = drawn(cloud, WIDE, box, config), traced(cloud, WIDE, box, config)
        assert image is not None
        assert float(((image - truth)[hit][:, :3].abs() > 1e-3).float().mean()) < 2e-3  # where two peaks are level
        more = drawn(cloud, WIDE, box, SplattingConfig(most=most + 1))
        assert more is not None
        assert float(((more - truth)[hit][:, :3].abs() > 1e-3).float().mean()) > 0.1


def test_without_the_pixel_s_width_too() -> None:
    cloud, box, config = random_cloud(40), turned(car_box(), 0.4, [0.5, 0.2, 12.0]), SplattingConfig(widen=False)
    image, (truth, hit) = drawn(cloud, WIDE, box, config), traced(cloud, WIDE, box, config)
    assert image is not None
    assert psnr(image[hit][:, :4], truth[hit][:, :4]) > 65


def test_silhouettes_are_where_a_gaussian_is_as_faint_as_counts() -> None:
    """On the edge of each conic the quotients of `Projected` give the limit, all around."""
    seen = project(bake_cloud(leaning_discs()), WIDE, turned(car_box(), 0.6, [0.4, 0.3, 4.5]))
    shown = np.flatnonzero(seen.limit > 0)
    u, v, uu, uv, vv, edge, half_width, half_height = _Seen.of(seen).silhouettes.astype(np.float64)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    x, y = np.cos(angle), np.sin(angle)
    reach = np.sqrt(edge / (uu * x * x + 2 * uv * x * y + vv * y * y))
    x, y = x * reach, y * reach
    assert np.abs(x).max(axis=0) == pytest.approx(half_width, rel=0.02)
    assert np.abs(y).max(axis=0) == pytest.approx(half_height, rel=0.02)
    x, y = x + u - seen.u[shown], y + v - seen.v[shown]
    below = 1 + 2 * (seen.g_u[shown] * x + seen.g_v[shown] * y)
    below += seen.h_uu[shown] * x * x + 2 * seen.h_uv[shown] * x * y + seen.h_vv[shown] * y * y
    above = seen.uu[shown] * x * x + 2 * seen.uv[shown] * x * y + seen.vv[shown] * y * y
    assert np.abs(above / below / seen.limit[shown] - 1).max() < 1e-3
    assert np.abs(above / seen.limit[shown] - 1).max() > 0.2  # of a plain ellipse it would not be the edge


def test_some_light_comes_through_every_gaussian() -> None:
    one = torch.zeros(1, 1, 3, dtype=torch.float64)
    cloud = GaussianCloud(one, one, torch.ones(1, 1, 4, dtype=torch.float64), one[..., 0] + 1.0, one + 0.5)
    far = Camera(torch.tensor([4200.0, 4200.0, 24.5, 24.5]), 49, 49)
    image = drawn(cloud, far, car_box(distance_m=100.0), SplattingConfig())
    assert image is not None
    assert float(image[..., 3].max()) == pytest.approx(MAX_ALPHA, abs=1e-6)


@pytest.mark.parametrize("center", [[0.4, 0.3, 3.4], [-1.4, 0.9, 4.0]])
def test_a_gaussian_is_drawn_as_far_as_it_reaches(center: list[float]) -> None:
    """Long ones near the camera, a picture each: silhouettes are found where the faintest alpha that counts is."""
    box = turned(car_box(), 0.6, center)
    generator, errors, num_lit = torch.Generator().manual_seed(2), [], 0
    for _ in range(30):
        draw = torch.rand(14, generator=generator, dtype=torch.float64)
        scale = torch.tensor([0.12, 0.01, 0.02], dtype=torch.float64).log()
        parts = draw[:3] - 0.5, scale, draw[3:7] - 0.5, torch.tensor(1.0, dtype=torch.float64), draw[7:10]
        cloud = GaussianCloud(*(part[None, None] for part in parts))
        image, (truth, hit) = drawn(cloud, WIDE, box, SplattingConfig()), traced(cloud, WIDE, box, SplattingConfig())
        assert image is not None
        lit = hit & (truth[..., 3] > 1.001 * FAINTEST)
        errors.append(float((image - truth)[lit][:, :4].abs().max()) if bool(lit.any()) else 0.0)
        num_lit += int(lit.sum())
    assert num_lit > 2_000
    assert max(errors) < 1e-4


def test_bands_and_chunks_change_no_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = project(bake_cloud(surface_cloud()), WIDE, car_box())
    whole = draw_exactly(seen, 97, 75, most=32)
    assert whole is not None
    assert float(whole[..., 3].max()) > 0.9
    for band, chunk in ((40, 2**17), (1, 1), (4096, 2**12)):
        monkeypatch.setattr(screen_tiles, "_BAND", band)
        monkeypatch.setattr(screen_tiles, "_CHUNK", chunk)
        parts = draw_exactly(seen, 97, 75, most=32)
        assert parts is not None
        assert np.abs(parts - whole)[..., :4].max() < 1e-4


def test_there_is_none_where_a_gaussian_reaches_the_camera_s_plane() -> None:
    cloud, config = random_cloud(30), SplattingConfig()
    assert drawn(cloud, WIDE, turned(car_box(), 0.0, [0.0, 0.0, 12.0]), config) is not None
    assert drawn(cloud, WIDE, turned(car_box(), 0.0, [0.0, 0.0, 1.0]), config) is None


@pytest.mark.parametrize("name", ["mean", "log_scale", "quaternion", "opacity"])
def test_numbers_that_are_not_finite_are_no_picture(name: str) -> None:
    """They are not left out in silence: whoever goes ray by ray then finds them."""
    cloud = surface_cloud()
    getattr(cloud, name)[0, 7] = torch.nan
    assert drawn(cloud, WIDE, car_box(), SplattingConfig()) is None


@pytest.mark.parametrize("center", [[60.0, 0.0, 9.0], [0.0, -1e6, 9.0]])
def test_a_picture_of_nothing_is_empty(center: list[float]) -> None:
    image = drawn(surface_cloud(), WIDE, turned(car_box(), 0.0, center), SplattingConfig())
    assert image is not None
    assert image.shape == (75, 97, 5)
    assert not image.any()


def test_gaussians_that_nobody_sees_are_no_picture() -> None:
    whole = surface_cloud()
    faint = GaussianCloud(whole.mean, whole.log_scale, whole.quaternion, whole.opacity * 1e-4, whole.rgb)
    image = drawn(faint, WIDE, car_box(), SplattingConfig())
    assert image is not None
    assert not image.any()
