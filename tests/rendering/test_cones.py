import math

import pytest
import torch

from carstudio.geometry.box3d import Box3D
from carstudio.rendering.cones import canonical_gaussians, frustum_moments, released_canonical_radius
from carstudio.rendering.rays import Rays, pixel_rays, to_canonical
from rendering.scenes import batched, kitti_camera, positions_on_box, tilted_box


def cone_points(t0: float, t1: float, radius: float, count: int) -> torch.Tensor:
    """Points drawn evenly from the volume of a cone frustum along +z, apex at the origin. (count, 3)"""
    generator = torch.Generator().manual_seed(3)
    u, disc, angle = torch.rand(3, count, generator=generator, dtype=torch.float64)
    t = (t0**3 + u * (t1**3 - t0**3)) ** (1 / 3)  # area grows with t^2
    r = radius * t * disc.sqrt()
    return torch.stack([r * (2 * math.pi * angle).cos(), r * (2 * math.pi * angle).sin(), t], dim=-1)


@pytest.mark.parametrize(("t0", "t1", "radius"), [(2.0, 5.0, 0.3), (9.0, 9.5, 0.01), (0.0, 1.0, 0.2)])
def test_moments_equal_monte_carlo(t0: float, t1: float, radius: float) -> None:
    points = cone_points(t0, t1, radius, 400_000)
    mean, t_variance, r_variance = frustum_moments(
        torch.tensor(t0).double(), torch.tensor(t1).double(), torch.tensor(radius).double()
    )
    # 400,000 draws: the standard error of a variance is about 0.3 %
    assert float(mean) == pytest.approx(float(points[:, 2].mean()), rel=2e-3)
    assert float(t_variance) == pytest.approx(float(points[:, 2].var()), rel=1e-2)
    assert float(r_variance) == pytest.approx(float(points[:, 0].var()), rel=1e-2)


def test_moments_equal_the_textbook_integrals() -> None:
    """mip-NeRF Eq. 7 before its stable rewriting, float64."""
    t0, t1, radius = 3.0, 4.5, 0.2
    ratio = lambda n: (t1**n - t0**n) / n  # noqa: E731
    mean = ratio(4) / ratio(3)
    t_variance = ratio(5) / ratio(3) - mean**2
    r_variance = radius**2 * ratio(5) / ratio(3) / 4
    found = frustum_moments(*(torch.tensor(x, dtype=torch.float64) for x in (t0, t1, radius)))
    assert [float(x) for x in found] == pytest.approx([mean, t_variance, r_variance], rel=1e-9)


def test_moments_and_gradients_are_finite_at_extremes() -> None:
    t0 = torch.tensor([0.0, 0.0, 1e-6, 1e4], requires_grad=True)
    t1 = torch.tensor([0.0, 1e-6, 2e-6, 1e4 + 1], requires_grad=True)
    moments = frustum_moments(t0, t1, torch.tensor(1e-3))
    torch.stack(moments).sum().backward()
    assert all(bool(torch.isfinite(m).all()) for m in moments)
    assert bool(torch.isfinite(t0.grad).all())
    assert bool(torch.isfinite(t1.grad).all())


def test_exact_map_equals_monte_carlo_of_mapped_points() -> None:
    """Points of the metric frustum carried into the canonical frame one by one: mean and diagonal covariance."""
    box = tilted_box()
    direction = torch.nn.functional.normalize(torch.tensor([-0.1, 0.12, 1.0], dtype=torch.float64), dim=0)
    radius, t0, t1 = 0.08, 8.5, 9.0
    helper = torch.linalg.cross(direction, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    x = helper / helper.norm()
    frame = torch.stack([x, torch.linalg.cross(direction, x), direction], dim=-1)
    points = cone_points(t0, t1, radius, 400_000) @ frame.T
    mapped = ((points - box.center) @ box.rotation[0]) * (2 / box.size)

    rays = Rays(torch.zeros(1, 1, 3).double(), direction[None, None], torch.tensor([[radius]]).double())
    edges = torch.tensor([[[t0, t1]]], dtype=torch.float64)
    gaussians = canonical_gaussians(to_canonical(rays, box), edges)
    assert torch.allclose(gaussians.mean[0, 0, 0], mapped.mean(dim=0), atol=3e-3)
    assert torch.allclose(gaussians.variance[0, 0, 0], mapped.var(dim=0), rtol=2e-2)


def test_exact_map_is_the_diagonal_of_a_sigma_at() -> None:
    box, camera = tilted_box(), kitti_camera()
    rays = pixel_rays(batched(camera), positions_on_box(box, camera, 20))
    canonical = to_canonical(rays, box)
    edges = torch.stack([canonical.near, canonical.far], dim=-1)
    found = canonical_gaussians(canonical, edges).variance[0, :, 0]
    _, t_variance, r_variance = frustum_moments(canonical.near, canonical.far, rays.radii)
    for i in range(20):
        d = rays.directions[0, i]
        outer = torch.outer(d, d)
        sigma = t_variance[0, i] * outer + r_variance[0, i] * (torch.eye(3) - outer)
        A = canonical.linear[0]
        assert torch.allclose(found[i], torch.diagonal(A @ sigma @ A.T), rtol=1e-9)


def test_isotropic_cone_on_a_cube_differs_by_its_radius_rule_alone() -> None:
    """A cubic box scales all axes alike: the two maps differ only in radius, 1 / sqrt(pi) against 1 / sqrt(3)."""
    box, camera = tilted_box(), kitti_camera()
    cube = Box3D(box.center, torch.full_like(box.size, 2.0), box.rotation)
    canonical = to_canonical(pixel_rays(batched(camera), positions_on_box(cube, camera, 30)), cube)
    assert torch.allclose(released_canonical_radius(canonical), canonical.radii * math.sqrt(3 / math.pi), rtol=1e-9)
    edges = torch.stack([canonical.near, (canonical.near + canonical.far) / 2, canonical.far], dim=-1)
    exact = canonical_gaussians(canonical, edges)
    round_cone = canonical_gaussians(canonical, edges, "isotropic-as-released")
    assert torch.allclose(exact.mean, round_cone.mean, rtol=1e-9)
    assert torch.allclose(exact.variance, round_cone.variance, rtol=0.1)


def test_isotropic_radius_covers_the_pixels_canonical_solid_angle() -> None:
    """Brute force: the solid angle of the quadrilateral spanned by the pixel's four canonical corner directions."""
    box, camera = tilted_box(), kitti_camera()
    positions = positions_on_box(box, camera, 10)
    canonical = to_canonical(pixel_rays(batched(camera), positions), box)
    steps = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
    corners = [
        to_canonical(pixel_rays(batched(camera), positions + torch.tensor(step)), box).view_directions[0]
        for step in steps
    ]
    diagonals = torch.linalg.cross(corners[2] - corners[0], corners[3] - corners[1]).norm(dim=-1) / 2
    # the small-angle area of the quadrilateral; pixel_width in `radii` is taken at the ray's own slant, hence 1 %
    slant = pixel_rays(batched(camera), positions).directions[0, :, 2]
    assert torch.allclose(math.pi * released_canonical_radius(canonical)[0] ** 2, diagonals / slant, rtol=2e-2)
