"""Rays and Gaussians: closed forms against dense sampling, the fast path against the plain one, and geometry."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from carstudio.geometry.box3d import Box3D, mirror_box
from carstudio.geometry.camera import Camera
from carstudio.geometry.canonical import canonical_from_camera
from carstudio.geometry.transforms import rotation_from_quaternion
from carstudio.rendering.gaussians import hits
from carstudio.rendering.gaussians.cloud import GaussianCloud, Splats, splats_of, widened_splats
from carstudio.rendering.gaussians.reference import MAX_ALPHA, responses, sorted_responses
from carstudio.rendering.gaussians.symmetric import Symmetric3, planes3
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud, trace_cloud
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import Rendering, composite, merge_segments
from rendering.gaussian_scenes import camera, car_box, leaves, random_cloud, surface_cloud
from rendering.scenes import batched, kitti_camera, positions_on_box, tilted_box

FAST, REFERENCE = SplattingConfig(most=200), SplattingConfig(is_reference=True)


def picture(cloud: GaussianCloud, box: Box3D, view: Camera, config: SplattingConfig = REFERENCE) -> Rendering:
    rays = image_rays(view)
    return composite(trace_cloud(cloud, rays, to_canonical(rays, box), config))


def test_peaks_are_the_maxima_along_the_ray() -> None:
    """Against the response sampled densely along each ray, its exponent written out with a matrix inverse."""
    cloud = random_cloud(12)
    box, view = tilted_box(), kitti_camera()
    rays = to_canonical(_rays(view, box, 20), box)
    middle = -(rays.origins * rays.view_directions).sum(-1)
    points = rays.origins + middle[..., None] * rays.view_directions
    alpha, t = responses(splats_of(cloud), points, rays.view_directions)
    at = torch.linspace(-4, 4, 8001, dtype=torch.float64)
    x = points[0, :, None, None] + at[:, None] * rays.view_directions[0, :, None, None] - cloud.mean[0, None, :, None]
    inverse = torch.linalg.inv(cloud.covariance().matrix()[0])
    exponent = torch.einsum("rnti,nij,rntj->rnt", x, inverse, x)
    found, place = (cloud.opacity[0, :, None] * torch.exp(-exponent / 2)).max(dim=-1)
    assert torch.allclose(alpha[0], found.clamp(max=MAX_ALPHA), atol=1e-3)  # 0.001 apart: a slope of 1 / (2 * 0.03)
    seen = found > 1e-3
    assert torch.allclose(t[0][seen], at[place][seen], atol=6e-4)


def _rays(view: Camera, box: Box3D, count: int) -> Rays:
    from carstudio.rendering.rays import pixel_rays

    return pixel_rays(batched(view), positions_on_box(box, view, count))


def test_cofactors_invert() -> None:
    matrix = random_cloud(30).covariance().matrix()
    found = Symmetric3.of_matrix(matrix)
    assert torch.equal(found.matrix(), matrix)
    assert torch.allclose(found.inverse().matrix(), torch.linalg.inv(matrix), rtol=1e-9)
    determinant = torch.linalg.det(matrix)[..., None, None]
    assert torch.allclose(found.cofactors().matrix(), determinant * torch.linalg.inv(matrix), rtol=1e-9)
    vector = torch.randn(*matrix.shape[:-1], dtype=matrix.dtype, generator=torch.Generator().manual_seed(0))
    along = torch.einsum("bni,bnij,bnj->bn", vector, matrix, vector)
    assert torch.allclose(found.quadratic(planes3(vector)), along, rtol=1e-9)


def test_covariances_are_those_of_rotated_axes() -> None:
    cloud = random_cloud(30)
    axes = rotation_from_quaternion(cloud.quaternion) * torch.exp(cloud.log_scale)[..., None, :]
    assert torch.allclose(cloud.covariance().matrix(), axes @ axes.mT, rtol=1e-9, atol=1e-15)


def test_the_plain_path_has_the_gradients_of_its_values() -> None:
    box, view = car_box(), camera(4)
    rays = image_rays(view)
    canonical = to_canonical(rays, box)

    def render(*parts: Tensor) -> tuple[Tensor, Tensor]:
        cloud = GaussianCloud(parts[0], parts[1], parts[2], parts[3].sigmoid(), parts[4])
        found = composite(trace_cloud(cloud, rays, canonical, REFERENCE))
        return found.rgb, found.opacity

    assert torch.autograd.gradcheck(render, leaves(random_cloud(5)), atol=1e-6)


def test_the_fast_path_has_the_gradients_of_its_values() -> None:
    """The closed-form backward, alpha and t, in float64 (two kinks, the faintest hit and the cap, stay clear of it)."""
    cloud = random_cloud(6, seed=4)
    rays = to_canonical(image_rays(camera(4)), car_box())
    middle = -(rays.origins * rays.view_directions).sum(-1)
    points = rays.origins + middle[..., None] * rays.view_directions

    def found(mean: Tensor, log_scale: Tensor, quaternion: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor]:
        splats = splats_of(GaussianCloud(mean, log_scale, quaternion, opacity.sigmoid(), mean))
        alpha, t, _ = hits.ray_hits(splats, points, rays.view_directions, -middle, most=4)
        return alpha, t

    assert bool((found(*leaves(cloud)[:4])[0] > 0).any())
    assert torch.autograd.gradcheck(found, leaves(cloud)[:4], atol=1e-6)


@pytest.mark.parametrize("config", [SplattingConfig(), REFERENCE], ids=["fast", "plain"])
def test_a_box_has_the_gradients_of_its_values(config: SplattingConfig) -> None:
    """Pose and size are found by them: colours, opacity and depth against central differences."""
    cloud, view, box = random_cloud(6, seed=4), camera(5), car_box()
    rays = image_rays(view)

    def render(center: Tensor, size: Tensor, rotation: Tensor) -> tuple[Tensor, ...]:
        canonical = to_canonical(rays, Box3D(center, size, rotation))
        found = render_cloud(cloud, rays, canonical, config)
        return found.rgb, found.opacity, found.distance_m * found.opacity

    given = [part.clone().requires_grad_() for part in (box.center, box.size, box.rotation)]
    assert float(render(*given)[1].detach().max()) > 0.1
    assert torch.autograd.gradcheck(render, given, atol=1e-5, eps=1e-6)


@pytest.mark.parametrize("make", [random_cloud, surface_cloud])
@pytest.mark.parametrize("chunk", [2**9, 2**17])
def test_the_fast_path_equals_the_plain_one(make, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """float32 against float64; a hit that is just too faint for one of the two makes the largest differences."""
    monkeypatch.setitem(hits._CHUNK, "cpu", chunk)
    weights = torch.randn(1, 32 * 32, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for dtype, config in ((torch.float64, REFERENCE), (torch.float32, FAST)):
        parts = leaves(make(dtype=dtype))
        found = picture(GaussianCloud(*parts), car_box(dtype), camera(32, dtype), config)
        loss = (found.rgb * weights.to(dtype)).sum() + found.opacity.square().sum()
        loss = loss + (found.depth_m * (found.opacity.detach() > 0.5)).sum()
        results.append((found, torch.autograd.grad(loss, parts)))
    (plain, plain_gradients), (fast, fast_gradients) = results
    for name, worst, mean in (("rgb", 5e-3, 1e-5), ("opacity", 5e-3, 1e-5)):
        error = (getattr(plain, name) - getattr(fast, name)).detach().abs()
        assert float(error.max()) < worst, name
        assert float(error.mean()) < mean, name
    solid = plain.opacity > 0.5
    assert float((plain.depth_m - fast.depth_m).detach()[solid].abs().max()) < 0.01
    for plain_gradient, fast_gradient in zip(plain_gradients, fast_gradients, strict=True):
        assert float((plain_gradient - fast_gradient).norm() / plain_gradient.norm()) < 2e-3


@pytest.mark.parametrize("make", [random_cloud, surface_cloud])
def test_the_short_way_equals_compositing_the_segments(make) -> None:
    """Values and gradients, colour, opacity and depth, in float64."""
    rays = image_rays(camera(12))
    canonical = to_canonical(rays, car_box())
    weights = torch.randn(1, 144, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    results = []
    for is_short in (False, True):
        parts = leaves(make())
        cloud = GaussianCloud(*parts)
        segments = (rays, canonical, FAST)
        found = render_cloud(cloud, *segments) if is_short else composite(trace_cloud(cloud, *segments))
        solid = found.opacity.detach() > 1e-3
        loss = (found.rgb * weights).sum() + found.opacity.square().sum() + (found.depth_m * solid).sum()
        results.append((found, torch.autograd.grad(loss, parts)))
    (plain, plain_gradients), (short, short_gradients) = results
    solid = plain.opacity > 1e-3
    assert torch.allclose(plain.rgb, short.rgb, atol=1e-12)
    assert torch.allclose(plain.opacity, short.opacity, atol=1e-12)
    assert torch.allclose(plain.depth_m[solid], short.depth_m[solid], atol=1e-9)
    assert torch.allclose(plain.distance_m[solid], short.distance_m[solid], atol=1e-9)
    for a, b in zip(plain_gradients, short_gradients, strict=True):
        assert float((a - b).norm()) < 1e-9 * float(a.norm())


def test_only_what_lies_behind_is_left_out() -> None:
    """With fewer hits allowed the front ones are the same to the bit."""
    rays = image_rays(camera(24, torch.float32))
    canonical = to_canonical(rays, car_box(torch.float32))
    cloud = surface_cloud(dtype=torch.float32)
    whole, few = (trace_cloud(cloud, rays, canonical, SplattingConfig(most=most)) for most in (100, 16))
    for name in ("alpha", "distance_m", "rgb"):
        assert torch.equal(getattr(whole, name)[:, :, :16], getattr(few, name)), name
    assert bool((whole.alpha[..., 16] > 0).any())


def test_a_metric_scene_looks_like_its_canonical_one() -> None:
    """The same Gaussians written in metres in the camera frame: same alphas, peaks at the same metric distance."""
    box, view = tilted_box(), kitti_camera()
    rays, cloud = _rays(view, box, 30), random_cloud(20)
    canonical = to_canonical(rays, box)
    inverse = torch.linalg.inv(canonical_from_camera(box)[0])
    linear = inverse[:3, :3]
    mean = cloud.mean @ linear.mT + inverse[:3, 3]
    precision = torch.linalg.inv(linear @ cloud.covariance().matrix() @ linear.mT)
    metric = Splats(mean, Symmetric3.of_matrix(precision), cloud.opacity)
    alpha, distance, _ = sorted_responses(metric, rays.origins, rays.directions, torch.zeros_like(rays.radii))
    found = trace_cloud(cloud, rays, canonical, replace(REFERENCE, widen=False))
    assert torch.allclose(found.alpha, alpha, atol=1e-9)
    assert torch.allclose(found.distance_m, distance, atol=1e-9)


def one_gaussian(mean: tuple[float, float, float], rgb: tuple[float, float, float], scale: float) -> GaussianCloud:
    as_batch = lambda *values: torch.tensor([[values]], dtype=torch.float64)  # noqa: E731
    opacity = torch.full((1, 1), 0.999, dtype=torch.float64)
    return GaussianCloud(
        as_batch(*mean), as_batch(scale, scale, scale).log(), as_batch(1.0, 0.0, 0.0, 0.0), opacity, as_batch(*rgb)
    )


def join(*clouds: GaussianCloud) -> GaussianCloud:
    return GaussianCloud(
        *(torch.cat(parts, dim=1) for parts in zip(*(list(vars(c).values())[:5] for c in clouds), strict=True))
    )


@pytest.mark.parametrize("config", [REFERENCE, FAST])
def test_a_ray_through_a_gaussian_sees_it_at_its_depth(config: SplattingConfig) -> None:
    box, mean = car_box(), (0.3, -0.2, 0.5)
    center = (torch.tensor(mean, dtype=torch.float64) * box.size / 2) @ box.rotation[0].mT + box.center
    wide = camera(64)
    view = wide.crop(0, 0, 1, 1)
    pixel = wide.project(center[None])[0, 0]
    view = Camera(
        view.intrinsics
        - torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64) * torch.cat([torch.zeros(2), pixel - 0.5]),
        1,
        1,
    )
    found = picture(one_gaussian(mean, (1.0, 0.5, 0.0), 0.05), box, view, replace(config, widen=False))
    assert float(found.depth_m) == pytest.approx(float(center[0, 2]), abs=2e-3)
    assert float(found.opacity) == pytest.approx(0.999, abs=1e-4)
    assert torch.allclose(found.rgb[0, 0] / found.opacity[0, 0], torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64))


@pytest.mark.parametrize("config", [REFERENCE, FAST])
def test_the_nearer_gaussian_hides_the_other(config: SplattingConfig) -> None:
    front = one_gaussian((0.7, 0.0, 0.0), (1.0, 0.0, 0.0), 0.8)
    rear = one_gaussian((-0.7, 0.0, 0.0), (0.0, 0.0, 1.0), 0.8)
    for azimuth, channel in ((0.0, 0), (180.0, 2)):  # from the front, from behind
        for cloud in (join(front, rear), join(rear, front)):
            found = picture(cloud, car_box(azimuth_deg=azimuth, elevation_deg=0.0), camera(9), config).rgb.reshape(
                9, 9, 3
            )[4, 4]
            assert float(found[channel]) > 0.9
            assert float(found[2 - channel]) < 0.1


@pytest.mark.parametrize("config", [REFERENCE, FAST])
def test_cars_hide_each_other_by_metric_distance(config: SplattingConfig) -> None:
    """Two cars of one cloud each, one behind the other; merged in either order the nearer is seen."""
    near, far = car_box(distance_m=8.0), car_box(distance_m=16.0)
    rays = image_rays(camera(16))
    red, blue = (replace(surface_cloud(200), rgb=torch.zeros(1, 200, 3, dtype=torch.float64)) for _ in range(2))
    red.rgb[..., 0], blue.rgb[..., 2] = 1.0, 1.0
    a = trace_cloud(red, rays, to_canonical(rays, near), config)
    b = trace_cloud(blue, rays, to_canonical(rays, far), config)
    for merged in (merge_segments(a, b), merge_segments(b, a)):
        assert bool((merged.distance_m.diff(dim=-1) >= 0).all())
        found = composite(merged)
        covered = composite(a).opacity > 0.99
        assert bool(covered.any())
        assert float(found.rgb[covered][:, 2].max()) < 0.02


@pytest.mark.parametrize("config", [REFERENCE, FAST])
def test_a_mirrored_scene_gives_the_flipped_picture(config: SplattingConfig) -> None:
    box, view = tilted_box(distance_m=6.0), Camera(torch.tensor([60.0, 55.0, 21.0, 14.0], dtype=torch.float64), 40, 30)
    straight = picture(random_cloud(), box, view, config).rgb.reshape(30, 40, 3)
    mirrored = picture(random_cloud().mirrored(), mirror_box(box), view.flip(), config).rgb.reshape(30, 40, 3)
    assert float(straight.max()) > 0.2
    assert torch.allclose(mirrored, straight.flip(1), atol=1e-9)


def test_mirroring_negates_z_of_the_covariance() -> None:
    cloud = random_cloud(20)
    n = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert torch.allclose(cloud.mirrored().covariance().matrix(), n @ cloud.covariance().matrix() @ n, atol=1e-12)
    assert torch.allclose(
        torch.linalg.det(rotation_from_quaternion(cloud.mirrored().quaternion)), torch.ones(20).double()
    )


def test_widened_gaussians_look_like_the_mean_over_the_pixel() -> None:
    """A 12-pixel picture of thin discs against the mean of a 15 times finer one, with and without widening."""
    cloud, box = surface_cloud(2000), car_box(distance_m=20.0)
    coarse, fine = camera(12), camera(12).resize(180, 180)
    truth = picture(cloud, box, fine, replace(FAST, widen=False)).rgb.reshape(12, 15, 12, 15, 3).mean(dim=(1, 3))
    errors = [
        float((picture(cloud, box, coarse, replace(FAST, widen=widen)).rgb.reshape(12, 12, 3) - truth).abs().mean())
        for widen in (False, True)
    ]
    assert errors[1] < 0.75 * errors[0], errors


def test_a_needle_seen_from_afar_keeps_its_share_of_the_light() -> None:
    """Widening keeps the light of a small Gaussian: opacity times its area across the line of sight."""
    cloud = one_gaussian((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 0.02)
    eye = torch.tensor([[9.0, 1.0, 2.0]], dtype=torch.float64)
    wide = widened_splats(cloud, eye, torch.full((1, 1, 3), 0.04, dtype=torch.float64))
    # round Gaussians: the area across grows with the variance, 0.0004 to 0.0404
    assert float(wide.opacity) == pytest.approx(0.999 * 0.0004 / 0.0404, rel=1e-9)
    assert torch.allclose(wide.precision.matrix()[0, 0], torch.eye(3, dtype=torch.float64) / 0.0404)


def test_a_tint_changes_colour_with_the_line_of_sight_only() -> None:
    """Red grows along x: seen from the front (looking along -x) it is darker than from behind, by its slope."""
    plain = one_gaussian((0.0, 0.0, 0.0), (0.5, 0.5, 0.5), 0.5)
    slope = torch.zeros(1, 1, 3, 3, dtype=torch.float64)
    slope[0, 0, 0, 0] = 0.3
    for azimuth, red in ((0.0, 0.2), (180.0, 0.8)):
        boxes = car_box(azimuth_deg=azimuth, elevation_deg=0.0)
        a, b = (picture(cloud, boxes, camera(9)) for cloud in (plain, replace(plain, tint=slope)))
        assert torch.equal(a.opacity, b.opacity)
        seen = (b.rgb / b.opacity[..., None])[0, 40]
        assert torch.allclose(seen, torch.tensor([red, 0.5, 0.5], dtype=torch.float64), atol=1e-3)


def test_peaks_a_micrometre_apart_keep_their_order() -> None:
    """In float32, on a ray through the middle of a row of Gaussians, whichever is first in the cloud."""
    at = (torch.arange(-4, 5) * 1e-6).flip(0)
    mean = torch.stack([at, torch.zeros(9), torch.zeros(9)], dim=-1)[None]
    cloud = GaussianCloud(
        mean, torch.full((1, 9, 3), -2.0), torch.tensor([1.0, 0, 0, 0]).expand(1, 9, 4), torch.full((1, 9), 0.5), mean
    )
    point, direction = torch.zeros(1, 1, 3), torch.tensor([[[1.0, 0.0, 0.0]]])
    _, t, index = hits.ray_hits(splats_of(cloud), point, direction, torch.full((1, 1), -9.0), most=9)
    assert index[0, 0].tolist() == list(range(8, -1, -1))
    assert torch.allclose(t[0, 0], at.flip(0), atol=1e-8)


@pytest.mark.parametrize("is_near", [False, True])
def test_what_is_no_number_is_seen(is_near: bool) -> None:
    """A damaged Gaussian must not vanish from picture and loss."""
    cloud = random_cloud(5)
    broken = replace(cloud, mean=cloud.mean.index_fill(1, torch.tensor([2]), torch.nan))
    points, directions = torch.zeros(1, 1, 3).double(), torch.tensor([[[0.0, 0.0, 1.0]]]).double()
    nearest = torch.full((1, 1), -0.5 if is_near else -9.0).double()
    for given, is_broken in ((cloud, False), (broken, True)):
        alpha, _, index = hits.ray_hits(splats_of(given), points, directions, nearest, most=5)
        assert bool(alpha.isnan().any()) is is_broken
        assert not is_broken or 2 in index[alpha.isnan()].tolist()


def test_rays_that_miss_the_box_meet_nothing() -> None:
    cloud, box = random_cloud(), car_box()
    rays = image_rays(camera(24))
    canonical = to_canonical(rays, box)
    assert not bool(canonical.hit.all())
    for config in (FAST, REFERENCE):
        assert float(trace_cloud(cloud, rays, canonical, config).alpha[~canonical.hit].abs().max()) == 0.0


def test_a_gaussian_behind_the_camera_is_not_seen() -> None:
    """The camera stands in the middle of the box and looks along x."""
    rotation = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    box = Box3D(torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[4.0, 1.5, 1.8]]).double(), rotation[None])
    for x, seen in ((0.5, True), (-0.5, False)):
        for config in (FAST, REFERENCE):
            found = picture(
                one_gaussian((x, 0.0, 0.0), (1.0, 1.0, 1.0), 0.1), box, camera(3), replace(config, widen=False)
            )
            assert (float(found.opacity[0, 4]) > 0.9) is seen
