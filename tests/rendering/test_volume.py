import math

import pytest
import torch
from scipy.integrate import quad

from carstudio.rendering.volume import (
    Segments,
    alpha_from_density,
    composite,
    merge_segments,
    over,
    weights_from_alpha,
)


def random_segments(count: int, *, rays: int = 6, seed: int = 0, near: float = 2.0) -> Segments:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    distance = near + draw(1, rays, count).cumsum(dim=-1)
    return Segments(distance, 0.9 * distance, 0.9 * draw(1, rays, count), draw(1, rays, count, 3))


def test_compositing_equals_a_slow_loop() -> None:
    segments = random_segments(9)
    found = composite(segments)
    for ray in range(6):
        light, rgb, opacity, depth = 1.0, torch.zeros(3).double(), 0.0, 0.0
        for i in range(9):
            alpha = float(segments.alpha[0, ray, i])
            rgb += light * alpha * segments.rgb[0, ray, i]
            opacity += light * alpha
            depth += light * alpha * float(segments.depth_m[0, ray, i])
            light *= 1 - alpha
        assert torch.allclose(found.rgb[0, ray], rgb)
        assert float(found.opacity[0, ray]) == pytest.approx(opacity)
        assert float(found.depth_m[0, ray]) == pytest.approx(depth / opacity)


def test_opacity_equals_the_papers_integral() -> None:
    """Eq. 5 by quadrature for a smooth density, against 4,000 intervals."""
    density = lambda t: 1.5 * math.exp(-((t - 3.0) ** 2))  # noqa: E731

    def integrand(t: float) -> float:
        return math.exp(-quad(density, 1.0, t)[0]) * density(t)

    expected = quad(integrand, 1.0, 6.0)[0]
    edges = torch.linspace(1.0, 6.0, 4001, dtype=torch.float64)
    middle = (edges[1:] + edges[:-1]) / 2
    sigma = torch.tensor([density(float(t)) for t in middle], dtype=torch.float64)
    weights = weights_from_alpha(alpha_from_density(sigma, edges.diff()))
    assert float(weights.sum()) == pytest.approx(expected, abs=1e-6)
    assert float(weights.sum()) == pytest.approx(1 - math.exp(-quad(density, 1.0, 6.0)[0]), abs=1e-6)


def test_splitting_an_interval_changes_nothing() -> None:
    density, length = torch.tensor([0.3, 1.2, 0.4]).double(), torch.tensor([0.5, 1.0, 0.2]).double()
    whole = weights_from_alpha(alpha_from_density(density, length))
    split_density = density[[0, 1, 1, 1, 2]]
    split_length = torch.tensor([0.5, 0.3, 0.3, 0.4, 0.2]).double()
    parts = weights_from_alpha(alpha_from_density(split_density, split_length))
    assert torch.allclose(parts[1:4].sum(), whole[1])
    assert torch.allclose(parts[4], whole[2])


def test_alpha_is_accurate_for_thin_and_thick_intervals() -> None:
    found = alpha_from_density(torch.tensor([1e-7, 1e4]), torch.tensor([1e-3, 1.0]))
    assert found.tolist() == pytest.approx([1e-10, 1.0], rel=1e-5)


def test_an_opaque_segment_hides_what_is_behind() -> None:
    segments = random_segments(4)
    segments.alpha[..., 1] = 1.0
    found = composite(segments)
    # a millionth survives by construction
    assert float(found.weights[..., 2:].max()) <= 1e-6
    assert torch.allclose(found.opacity, torch.ones_like(found.opacity), atol=1e-6)


def test_gradients_pass_gradcheck_and_stay_finite_at_the_ends() -> None:
    alpha = torch.rand(3, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.9
    assert torch.autograd.gradcheck(weights_from_alpha, alpha.requires_grad_())
    extreme = torch.tensor([[0.0, 1.0, 0.5, 1.0, 0.0]], requires_grad=True)
    (weights_from_alpha(extreme) * torch.arange(5.0)).sum().backward()
    assert bool(torch.isfinite(extreme.grad).all())


def test_merging_equals_compositing_nearer_over_farther() -> None:
    """Objects that do not overlap in distance: merged compositing is the classical `over`."""
    near, far = random_segments(4, near=1.0, seed=1), random_segments(5, near=50.0, seed=2)
    front, back, merged = composite(near), composite(far), composite(merge_segments(far, near))
    expected = front.rgb + (1 - front.opacity[..., None]) * back.rgb
    assert torch.allclose(merged.rgb, expected)
    assert torch.allclose(merged.opacity, front.opacity + (1 - front.opacity) * back.opacity)


def test_merge_order_does_not_matter_and_empty_objects_do_nothing() -> None:
    a, b = random_segments(4, seed=1), random_segments(5, seed=2)
    empty = Segments(a.distance_m, a.depth_m, torch.zeros_like(a.alpha), a.rgb)
    ab, ba = composite(merge_segments(a, b)), composite(merge_segments(b, a))
    assert torch.allclose(ab.rgb, ba.rgb)
    assert torch.allclose(composite(merge_segments(a, empty)).rgb, composite(a).rgb)
    assert bool((merge_segments(a, b).distance_m.diff(dim=-1) >= 0).all())


def test_over_fills_with_the_background() -> None:
    segments = random_segments(3)
    found = composite(segments)
    white = over(found, torch.ones(1, 1, 3).double())
    assert torch.allclose(white - found.rgb, (1 - found.opacity)[..., None].expand(1, 6, 3))


def test_rays_without_anything_are_black_and_finite() -> None:
    nothing = torch.zeros(1, 2, 3)
    found = composite(Segments(nothing, nothing, nothing, torch.ones(1, 2, 3, 3)))
    assert float(found.opacity.max()) == 0.0
    assert float(found.depth_m.max()) == 0.0
