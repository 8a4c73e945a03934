"""Tiles of rays leave out early only what they miss."""

import pytest
import torch

from carstudio.models.interface import tiles_that_hit
from carstudio.rendering.gaussians import hits, tiles, tracing
from carstudio.rendering.gaussians.cloud import GaussianCloud, splats_of
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud, trace_cloud
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import composite
from rendering.gaussian_scenes import camera, car_box, leaves, random_cloud, surface_cloud


def tile_rays(side: int, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays of an image in the order of 4 x 4 tiles."""
    pixels = tiles_that_hit(torch.ones(side, side, dtype=torch.bool), tiles.TILE_PX)
    return image_rays(camera(side, dtype)).select(pixels)


@pytest.mark.parametrize("make", [random_cloud, surface_cloud])
def test_tiles_leave_out_nothing_that_is_met(make, monkeypatch: pytest.MonkeyPatch) -> None:
    """By tiles and ray by ray: the same alphas, distances and gradients."""
    rays, results = tile_rays(48), []
    canonical = to_canonical(rays, car_box())
    for coherent in (0.7, 0.0):
        monkeypatch.setattr(tiles, "COHERENT", coherent)
        parts = leaves(make())
        found = trace_cloud(GaussianCloud(*parts), rays, canonical, SplattingConfig(most=400))
        width = found.alpha.shape[-1]
        loss = (composite(found).rgb * torch.linspace(0, 1, 3)).sum()
        results.append((found, width, torch.autograd.grad(loss, parts)))
    (tiled, few, tiled_gradients), (whole, many, whole_gradients) = results
    assert few < many, "tiles left nothing out"
    # peaks closer than the keys tell apart (a micrometre or two) may change places
    error = (tiled.alpha.sort().values - whole.alpha.sort().values[..., -few:]).detach().abs()
    assert float(error.max()) < 1.001 * hits.FAINTEST  # of those that are just worth showing
    assert float(error.mean()) < 1e-7
    assert float(whole.alpha[..., few:].detach().max()) == 0.0
    lit = tiled.alpha > 0
    assert torch.allclose(tiled.distance_m[lit], whole.distance_m[..., :few][lit], atol=2e-5)
    for a, b in zip(tiled_gradients, whole_gradients, strict=True):
        assert float((a - b).norm()) < 1e-3 * float(a.norm())


def test_classes_of_tiles_give_the_same_picture_with_less_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    """One class and four: colour, opacity, distance and gradients; some tiles of the picture meet nothing."""
    rays = tile_rays(48)
    canonical = to_canonical(rays, car_box())
    counted, work, results = tiles.encounter, [], []

    def encounter(*arguments: torch.Tensor) -> list[tiles.Encounter]:
        met = counted(*arguments)
        work.append(sum(one.opacity.numel() for one in met))
        return met

    monkeypatch.setattr(tracing, "encounter", encounter)
    for classes in (1, 4):
        monkeypatch.setattr(tiles, "CLASSES", classes)
        parts = leaves(surface_cloud())
        short = render_cloud(GaussianCloud(*parts), rays, canonical, SplattingConfig(most=400))
        segments = trace_cloud(GaussianCloud(*parts), rays, canonical, SplattingConfig(most=400))
        assert torch.allclose(composite(segments).rgb, short.rgb, atol=1e-9)
        assert torch.equal(segments.distance_m, segments.distance_m.sort(dim=-1).values)
        gradients = torch.autograd.grad((short.rgb * torch.linspace(0, 1, 3)).sum(), parts)
        results.append((short, gradients))
    assert work[2] < 0.8 * work[0]
    (one, one_gradients), (four, four_gradients) = results
    assert float(one.opacity.detach().min()) == 0.0
    assert float(one.opacity.detach().max()) > 0.9
    for name in ("rgb", "opacity", "distance_m"):
        assert torch.allclose(getattr(one, name), getattr(four, name), atol=1e-6)
    for a, b in zip(one_gradients, four_gradients, strict=True):
        assert float((a - b).norm()) < 1e-3 * float(a.norm())


def test_scattered_rays_are_no_tiles() -> None:
    rays = image_rays(camera(32))
    order = torch.randperm(1024, generator=torch.Generator().manual_seed(0))
    canonical, splats = to_canonical(rays.select(order), car_box()), splats_of(surface_cloud())
    points = torch.zeros_like(canonical.origins)
    (met,) = tiles.encounter(splats, surface_cloud().rgb, points, canonical.view_directions, canonical.near)
    assert met.opacity.shape == (1, 400)
    assert met.features.shape == (1, 1024, 25)


@pytest.mark.parametrize(("height", "width"), [(8, 8), (7, 10), (1, 1), (4, 13)])
@pytest.mark.parametrize("side", [1, 4])
def test_touched_tiles_cover_all_hits_tile_by_tile(height: int, width: int, side: int) -> None:
    hit = torch.rand(height, width, generator=torch.Generator().manual_seed(height)) < 0.3
    pixels = tiles_that_hit(hit, side).unflatten(0, (-1, side * side))
    assert set(hit.flatten().nonzero().flatten().tolist()) <= set(pixels.flatten().tolist())
    for tile in pixels.tolist():
        places = {(pixel // width // side, pixel % width // side) for pixel in tile}
        assert len(places) == 1
        assert any(bool(hit.flatten()[pixel]) for pixel in tile)
