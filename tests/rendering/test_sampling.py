import numpy as np
import torch

from carstudio.rendering.sampling import blur_weights, resampled_edges, stratified_edges


def test_edges_without_generator_are_even() -> None:
    edges = stratified_edges(torch.tensor([2.0]), torch.tensor([6.0]), 4)
    assert edges.tolist() == [[2.0, 3.0, 4.0, 5.0, 6.0]]


def test_jittered_edges_stay_in_their_cells_and_fill_them() -> None:
    near, far = torch.full((4000,), 2.0), torch.full((4000,), 6.0)
    edges = stratified_edges(near, far, 4, torch.Generator().manual_seed(0))
    assert bool((edges.diff(dim=-1) >= 0).all())
    low, high = edges.amin(dim=0), edges.amax(dim=0)
    assert torch.allclose(low, torch.tensor([2.0, 2.5, 3.5, 4.5, 5.5]), atol=5e-3)
    assert torch.allclose(high, torch.tensor([2.5, 3.5, 4.5, 5.5, 6.0]), atol=5e-3)
    assert torch.allclose(edges.mean(dim=0), torch.tensor([2.25, 3.0, 4.0, 5.0, 5.75]), atol=2e-2)


def test_the_same_seed_gives_the_same_edges() -> None:
    near, far = torch.zeros(3), torch.ones(3)
    a, b = (stratified_edges(near, far, 8, torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(a, b)


def test_blur_equals_a_slow_loop() -> None:
    weights = [0.0, 0.0, 0.5, 0.1, 0.0]
    padded = [weights[0], *weights, weights[-1]]
    expected = []
    for i in range(len(weights)):
        left = max(padded[i], padded[i + 1])
        right = max(padded[i + 1], padded[i + 2])
        expected.append((left + right) / 2 + 0.01)
    assert np.allclose(blur_weights(torch.tensor([weights]))[0].numpy(), expected)


def test_resampling_equals_numpys_inverse_cdf() -> None:
    edges, weights = torch.tensor([[0.0, 1.0, 2.0, 4.0]]).double(), torch.tensor([[0.2, 0.7, 0.1]]).double()
    found = resampled_edges(edges, weights, 10)
    expected = np.interp(np.linspace(0, 1, 11), [0.0, 0.2, 0.9, 1.0], [0.0, 1.0, 2.0, 4.0])
    assert np.allclose(found[0].numpy(), expected)


def test_random_resampling_follows_the_weights() -> None:
    """Histogram of 200,000 edges against the weights: 3 standard errors are under 0.004."""
    edges = torch.tensor([0.0, 1.0, 2.0, 4.0]).expand(20_000, 4).contiguous()
    weights = torch.tensor([0.2, 0.7, 0.1]).expand(20_000, 3).contiguous()
    found = resampled_edges(edges, weights, 9, torch.Generator().manual_seed(2))
    share, _ = np.histogram(found.numpy(), bins=[0.0, 1.0, 2.0, 4.0])
    assert np.allclose(share / share.sum(), [0.2, 0.7, 0.1], atol=4e-3)
    assert bool((found.diff(dim=-1) >= 0).all())


def test_empty_rays_give_no_nan_and_stay_inside() -> None:
    edges = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    found = resampled_edges(edges, torch.zeros(2, 2), 5)
    assert bool(torch.isfinite(found).all())
    assert float(found[1].min()) >= 1.0
    assert float(found[1].max()) <= 3.0


def test_no_gradient_flows_through_the_places() -> None:
    weights = torch.tensor([[0.2, 0.8]], requires_grad=True)
    assert not resampled_edges(torch.tensor([[0.0, 1.0, 2.0]]), weights, 4).requires_grad
