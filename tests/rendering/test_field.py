import math

import torch

from carstudio.geometry.box3d import Box3D
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.field import SamplingConfig, trace_field
from carstudio.rendering.rays import pixel_rays, to_canonical
from carstudio.rendering.volume import Rendering, composite
from rendering.scenes import batched, kitti_camera, positions_on_box, tilted_box

SIGMA = 0.8


def fog(gaussians: Gaussians, view_directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The same density everywhere; colour is the place."""
    density = torch.full(gaussians.mean.shape[:-1], SIGMA, dtype=gaussians.mean.dtype)
    return density, (gaussians.mean + 1) / 2


def ball(gaussians: Gaussians, view_directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """An opaque ball of radius 1/2 in the canonical frame: an ellipsoid in metres."""
    inside = gaussians.mean.norm(dim=-1) < 0.5
    return inside.to(gaussians.mean.dtype) * 1e4, torch.ones_like(gaussians.mean)


def render(field, box: Box3D, config: SamplingConfig, generator=None) -> Rendering:
    camera = kitti_camera()
    rays = pixel_rays(batched(camera), positions_on_box(box, camera, 60))
    return composite(trace_field(field, rays, to_canonical(rays, box), config, generator)[-1])


def test_fog_has_the_closed_forms_opacity() -> None:
    """1 - exp(-sigma times the chord's canonical length), the chord found from metric end points."""
    box, camera = tilted_box(), kitti_camera()
    rays = pixel_rays(batched(camera), positions_on_box(box, camera, 60))
    canonical = to_canonical(rays, box)
    ends = [
        ((rays.directions * t[..., None] - box.center[:, None]) @ box.rotation) * (2 / box.size)
        for t in (canonical.near, canonical.far)
    ]
    expected = 1 - torch.exp(-SIGMA * (ends[1] - ends[0]).norm(dim=-1))
    for config in (SamplingConfig(coarse=8, fine=0), SamplingConfig(coarse=8, fine=16)):
        assert torch.allclose(render(fog, box, config).opacity, expected, atol=1e-9)


def test_a_car_is_as_opaque_at_40_m_as_at_5_m() -> None:
    def opacity(distance_m: float) -> float:
        rays = pixel_rays(batched(kitti_camera()), torch.tensor([[[609.5593, 172.854]]], dtype=torch.float64))
        turned = tilted_box().rotation
        ahead = torch.tensor([[0.0, 0.0, distance_m]], dtype=torch.float64)
        box = Box3D(ahead, torch.tensor([[4.2, 1.5, 1.8]], dtype=torch.float64), turned)
        segments = trace_field(fog, rays, to_canonical(rays, box), SamplingConfig(coarse=16, fine=0))
        return float(composite(segments[-1]).opacity)

    assert math.isclose(opacity(5.0), opacity(40.0), rel_tol=1e-9)


def test_depth_is_the_surface_of_an_ellipsoid() -> None:
    """Closed form: the first root of |o + t d| = 1/2 in the canonical frame; t is metric, depth is t d_z."""
    box, camera = tilted_box(), kitti_camera()
    middle = batched(camera).project(box.center[:, None])
    rays = pixel_rays(batched(camera), middle + torch.tensor([[[0.0, 0.0], [9.0, 4.0], [-14.0, -3.0]]]))
    canonical = to_canonical(rays, box)
    o, d = canonical.origins, canonical.directions
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 0.25
    root = (-b - (b * b - a * c).sqrt()) / a
    found = composite(trace_field(ball, rays, canonical, SamplingConfig(coarse=256, fine=512))[-1])
    assert torch.allclose(found.distance_m, root, atol=0.02)  # an interval of the coarse pass is 0.017 m
    assert torch.allclose(found.depth_m, root * rays.directions[..., 2], atol=0.02)


def test_the_fine_pass_finds_the_surface_better_than_as_many_even_samples() -> None:
    box = tilted_box()
    exact = render(ball, box, SamplingConfig(coarse=4096, fine=0))
    seen = exact.opacity > 0.999
    even = render(ball, box, SamplingConfig(coarse=64, fine=0)).distance_m
    placed = render(ball, box, SamplingConfig(coarse=32, fine=32)).distance_m
    error = lambda x: float((x - exact.distance_m)[seen].abs().mean())  # noqa: E731
    assert error(placed) < 0.6 * error(even)


def test_random_sampling_is_unbiased_for_fog_and_reproducible() -> None:
    box, config = tilted_box(), SamplingConfig(coarse=8, fine=8)
    a, b = (render(fog, box, config, torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(a.rgb, b.rgb)
    assert not torch.equal(a.rgb, render(fog, box, config).rgb)


def test_rays_that_miss_see_nothing() -> None:
    rays = pixel_rays(batched(kitti_camera()), torch.tensor([[[3.0, 3.0]]], dtype=torch.float64))
    segments = trace_field(fog, rays, to_canonical(rays, tilted_box()), SamplingConfig(coarse=8, fine=8))[-1]
    assert float(segments.alpha.abs().max()) == 0.0
