"""Tiles of rays leave out early only what they miss."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.models.interface import tiles_that_hit, window_of
from carstudio.rendering.gaussians import hits, tiles
from carstudio.rendering.gaussians.cloud import GaussianCloud, splats_of
from carstudio.rendering.gaussians.reference import reach_limit
from carstudio.rendering.gaussians.tracing import SplattingConfig, trace_cloud
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import Segments, composite
from rendering.gaussian_scenes import camera, car_box, leaves, random_cloud, surface_cloud


def tile_rays(side: int, dtype: torch.dtype = torch.float64) -> Rays:
    """Rays of an image in the order of 4 x 4 tiles."""
    pixels = tiles_that_hit(torch.ones(side, side, dtype=torch.bool), tiles.TILE_PX)
    return image_rays(camera(side, dtype)).select(pixels)


def seen_from(box: Box3D) -> Rays:
    """48 x 48 rays in tiles, all over the part of the image where the box is."""
    whole = camera(960)
    x, y, width, height = window_of(box, whole)
    pixels = tiles_that_hit(torch.ones(48, 48, dtype=torch.bool), tiles.TILE_PX)
    return image_rays(whole.crop(x, y, width, height).resize(48, 48)).select(pixels)


Traced = tuple[Segments, list[Tensor]]


def traced(cloud: GaussianCloud, rays: Rays, box: Box3D) -> Traced:
    """Segments, and gradients of a sum of what is seen."""
    parts = leaves(cloud)
    found = trace_cloud(GaussianCloud(*parts), rays, to_canonical(rays, box), SplattingConfig(most=400))
    shown = composite(found)
    loss = (shown.rgb * torch.linspace(0, 1, 3)).sum() + shown.depth_m.sum()
    return found, list(torch.autograd.grad(loss, parts))


def classes_of(cloud: GaussianCloud, rays: Rays, box: Box3D) -> list[tiles.TileClass] | None:
    canonical = to_canonical(rays, box)
    return tiles.tile_classes(splats_of(cloud), canonical.origins, canonical.view_directions)


def num_tried(classes: list[tiles.TileClass] | None) -> int:
    """Pairs of a tile and a Gaussian, padding included."""
    assert classes is not None
    return sum(one.splats.numel() for one in classes)


VIEWS = {
    "usual": car_box(),
    "from behind and above": car_box(azimuth_deg=190.0, elevation_deg=60.0),
    "far": car_box(distance_m=80.0),
    "at the bumper": car_box(azimuth_deg=0.0, distance_m=4.3),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("make", [random_cloud, surface_cloud])
def test_tiles_leave_out_nothing_that_is_met(make, view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By tiles and ray by ray: the same alphas, distances and gradients."""
    box = VIEWS[view]
    rays, cloud = seen_from(box), make()
    assert num_tried(classes_of(cloud, rays, box)) < 0.75 * 144 * cloud.opacity.numel(), (
        "tiles left hardly anything out"
    )
    tiled, tiled_gradients = traced(cloud, rays, box)
    monkeypatch.setattr(tiles, "LARGEST_TILE", 0.0)
    whole, whole_gradients = traced(cloud, rays, box)
    assert float(whole.alpha.detach().max()) > 0.1
    assert float((tiled.alpha - whole.alpha).detach().abs().max()) < 1e-12
    assert torch.allclose(tiled.distance_m, whole.distance_m, atol=1e-9)
    for a, b in zip(tiled_gradients, whole_gradients, strict=True):
        assert float((a - b).norm()) < 1e-9 * float(b.norm())


def test_classes_of_tiles_give_the_same_picture_with_less_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    """One class and as many as there may be; some tiles of the picture meet nothing and are in none."""
    rays, box, work, results = tile_rays(48), car_box(), [], []
    for classes in (1, 4):
        monkeypatch.setattr(tiles, "CLASSES", classes)
        found = classes_of(surface_cloud(), rays, box)
        assert found is not None
        assert len(found) == min(classes, 3)  # of 48 tiles or so, 16 at least in each
        seen = torch.cat([one.tiles for one in found])
        assert len(set(seen.tolist())) == len(seen) < 144
        work.append(num_tried(found))
        results.append(traced(surface_cloud(), rays, box))
    assert work[1] < 0.8 * work[0]
    (one, one_gradients), (four, four_gradients) = results
    assert float((one.alpha - four.alpha).detach().abs().max()) < 1e-12
    assert torch.equal(one.distance_m, one.distance_m.sort(dim=-1).values)
    for a, b in zip(one_gradients, four_gradients, strict=True):
        assert float((a - b).norm()) < 1e-9 * float(b.norm())


def test_a_gaussian_is_in_the_tiles_where_its_edge_is_and_in_no_others() -> None:
    """Points drawn on the ellipsoids where alpha is the faintest that counts: the rectangles hold and touch them."""
    cloud, box = random_cloud(40), car_box()
    splats = splats_of(cloud)
    eye = to_canonical(tile_rays(4), box).origins[:, 0]
    axes = tiles._looking_at_the_middle(eye)
    assert torch.allclose(axes @ axes.mT, torch.eye(3, dtype=axes.dtype), atol=1e-12)
    assert torch.allclose((axes @ eye[..., None]).squeeze(), torch.tensor([0, 0, -float(eye.norm())]).double())
    low, high = tiles._rectangles(splats, eye, axes)
    unit = torch.nn.functional.normalize(
        torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1
    )
    root = torch.linalg.cholesky(cloud.covariance().matrix()[0])
    limit = reach_limit(splats.opacity)[0].clamp(min=0)
    edge = (unit @ root.mT) * limit.sqrt()[:, None, None] + cloud.mean[0, :, None]
    seen = (edge - eye) @ axes[0].T
    bearings = seen[..., :2] / seen[..., 2:]
    counts = limit > 0
    size = (high - low)[:, 0, counts].T
    below = (bearings.amin(dim=1)[counts] - low[:, 0, counts].T) / size
    above = (high[:, 0, counts].T - bearings.amax(dim=1)[counts]) / size
    for gap in (below, above):
        assert float(gap.min()) >= 0
        assert float(gap.max()) < 0.02
    assert bool((low[:, 0, ~counts] == torch.inf).all())


def test_what_reaches_to_the_camera_or_is_no_number_is_left_to_the_rays() -> None:
    """Beside the camera and behind it; with a mean that is no number; too faint to count."""
    box = car_box(azimuth_deg=0.0, distance_m=4.3)
    rays = seen_from(box)
    eye = to_canonical(rays, box).origins[0, 0]
    cloud = random_cloud(4)
    cloud.mean[0, 0] = eye + 0.05
    cloud.log_scale[0, 0] = -1.0
    cloud.opacity[0, :3] = 0.9
    cloud.mean[0, 1] = torch.nan
    cloud.opacity[0, 3] = hits.FAINTEST / 2
    found = classes_of(cloud, rays, box)
    assert found is not None
    for one in found:
        assert bool((one.splats == 0).any(dim=1).all())
        assert bool((one.splats == 1).any(dim=1).all())
        assert not bool((one.splats == 3).any())


def test_a_ray_that_is_no_number_is_seen_and_costs_no_other() -> None:
    rays, cloud, box = tile_rays(48), surface_cloud(), car_box()
    directions = rays.directions.clone()
    directions[:, 700] = torch.nan
    broken = replace(rays, directions=directions)
    assert classes_of(cloud, broken, box) is not None
    config = SplattingConfig(most=400, widen=False)  # a footprint is the mean of all rays'
    found = trace_cloud(cloud, broken, to_canonical(broken, box), config)
    whole = trace_cloud(cloud, rays, to_canonical(rays, box), config)
    others = torch.arange(48 * 48) != 700
    assert torch.equal(found.alpha[:, others], whole.alpha[:, others])
    assert bool(found.distance_m[:, 700].isnan().any())


def test_scattered_rays_are_no_tiles() -> None:
    """Nor are rays of two cameras, nor those of a camera beside the car's middle."""
    rays, cloud = tile_rays(32), surface_cloud()
    assert classes_of(cloud, rays, car_box()) is not None
    order = torch.randperm(1024, generator=torch.Generator().manual_seed(0))
    assert classes_of(cloud, rays.select(order), car_box()) is None
    assert classes_of(cloud, rays.select(torch.arange(1000)), car_box()) is None
    assert classes_of(cloud, rays, car_box(distance_m=1.5)) is None
    moved = rays.origins.clone()
    moved[:, -1] += 0.01
    assert classes_of(cloud, replace(rays, origins=moved), car_box()) is None


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
