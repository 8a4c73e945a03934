"""Gaussians in the image: against the definition along rays, and against pictures traced ray by ray."""

import dataclasses

import numpy as np
import pytest
import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.rendering.gaussians import screen_tiles
from carstudio.rendering.gaussians.cloud import GaussianCloud
from carstudio.rendering.gaussians.ellipses import Ellipses, ellipses_of
from carstudio.rendering.gaussians.projection import bake_cloud, project
from carstudio.rendering.gaussians.reference import responses
from carstudio.rendering.gaussians.screen import draw_ellipses
from carstudio.rendering.gaussians.screen_tiles import Band, pairs_met
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud, splats_seen
from carstudio.rendering.rays import image_rays, to_canonical
from rendering.gaussian_scenes import car_box, random_cloud, surface_cloud

FAR_M, FAR_SIDE = 500.0, 48
WIDE = Camera(torch.tensor([130.0, 150.0, 40.0, 20.0]), 97, 75)
FAR = Camera(torch.tensor([4200.0, 3900.0, 25.3, 21.8]), FAR_SIDE, FAR_SIDE)  # rays are nearly parallel


def ellipses(cloud: GaussianCloud, camera: Camera, box: Box3D) -> Ellipses:
    return ellipses_of(project(bake_cloud(cloud), camera, box))


def few(count: int) -> GaussianCloud:
    """Gaussians of which every one is seen, with a colour that changes with the line of sight."""
    cloud = random_cloud(count)
    tint = torch.rand(1, count, 3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.5
    return dataclasses.replace(cloud, opacity=cloud.opacity * 0.5 + 0.4, tint=tint)


def test_ellipses_give_the_alphas_that_rays_meet_from_afar() -> None:
    cloud, box = few(20), car_box(distance_m=FAR_M)
    camera = Camera(FAR.intrinsics.double(), FAR.width, FAR.height)
    rays = image_rays(camera)
    canonical = to_canonical(rays, box)
    directions = canonical.view_directions
    middle = -(canonical.origins * directions).sum(dim=-1)
    alpha, t = responses(
        splats_seen(cloud, rays, canonical), canonical.origins + middle[..., None] * directions, directions
    )
    depth = (t + middle[..., None]) / canonical.stretch[..., None] * rays.directions[..., 2:]
    found = ellipses(cloud, camera, box)
    u, v, uu, uv, vv, _, _, _, log_opacity, at, at_u, at_v = found.table[:12, None, :]
    x = (np.arange(FAR_SIDE**2) % FAR_SIDE + 0.5)[:, None] - u
    y = (np.arange(FAR_SIDE**2) // FAR_SIDE + 0.5)[:, None] - v
    mine = np.exp(log_opacity - (uu * x * x + 2 * uv * x * y + vv * y * y) / 2)
    assert found.table.shape[1] == 20
    assert np.abs(mine - alpha[0].numpy()).max() < 0.01
    lit = alpha[0].numpy() > 0.05
    assert np.abs(at + at_u * x + at_v * y - depth[0].numpy())[lit].max() < 0.02  # of half a kilometre
    eye = canonical.origins.mean(dim=1)
    assert np.abs(found.table[12:].T - cloud.colour_from(eye)[0].numpy()).max() < 1e-5


@pytest.mark.parametrize("shift_px", [0.0, 0.5])
def test_a_gaussian_alone_is_drawn_as_it_is_traced(shift_px: float) -> None:
    """And half a pixel beside its place it would not be."""
    for number in range(6):
        whole = few(6)
        parts = {name: value[:, number : number + 1] for name, value in vars(whole).items() if value is not None}
        cloud = GaussianCloud(**parts)
        box = car_box(distance_m=FAR_M)
        rays = image_rays(Camera(FAR.intrinsics.double(), FAR.width, FAR.height))
        traced = render_cloud(cloud, rays, to_canonical(rays, box), SplattingConfig())
        moved = Camera(FAR.intrinsics + torch.tensor([0.0, 0.0, shift_px, 0.0]), FAR.width, FAR.height)
        image = torch.from_numpy(draw_ellipses(ellipses(cloud, moved, box), FAR.width, FAR.height)).flatten(0, 1)
        error = float((image[:, 3] - traced.opacity[0]).abs().max())
        assert (error < 0.01) is (shift_px == 0)
        if shift_px == 0:
            assert float((image[:, :3] - traced.rgb[0]).abs().max()) < 0.01
            lit = traced.opacity[0] > 0.1
            assert float((image[:, 4] - traced.depth_m[0])[lit].abs().max()) < 0.02


def test_an_ellipse_enters_the_tiles_of_which_it_holds_a_pixel() -> None:
    """Against every pixel centre tried with every ellipse; what slips in between pixel centres may be entered too."""
    table = ellipses(random_cloud(80), WIDE, car_box(distance_m=5.0)).table[:8].astype(np.float64)
    u, v, uu, uv, vv, limit = table[:6, :, None, None]
    rows, columns = -(-WIDE.height // 4), -(-WIDE.width // 4)
    y, x = np.mgrid[: rows * 4, : columns * 4] + 0.5
    inside = uu * (x - u) ** 2 + 2 * uv * (x - u) * (y - v) + vv * (y - v) ** 2 < limit
    is_met = inside.reshape(-1, rows, 4, columns, 4).any(axis=(2, 4))
    assert is_met[:, 0].any()  # some reach over the picture's edge
    found = np.zeros_like(is_met)
    for first, count in ((0, 5), (5, rows - 5)):
        pairs = pairs_met(table, Band(first, np.empty((count, columns, 4, 4, 5), np.float32)))
        row, column = first + pairs.tile // columns, pairs.tile % columns
        assert np.allclose(table[0, pairs.splat] + pairs.u, column * 4 + 2)
        assert np.allclose(table[1, pairs.splat] + pairs.v, row * 4 + 2)
        assert not found[pairs.splat, row, column].any()  # each pair once
        found[pairs.splat, row, column] = True
    assert not (is_met & ~found).any()
    assert (found & ~is_met).sum() < 0.1 * is_met.sum()


def test_bands_and_chunks_change_no_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera(torch.tensor([300.0, 300.0, 70.0, 51.0]), 137, 101)  # no multiples of a tile
    found = ellipses(surface_cloud(), camera, car_box())
    whole = draw_ellipses(found, 137, 101)
    assert whole.shape == (101, 137, 5)
    assert float(whole[..., 3].max()) > 0.9
    for band, chunk in ((40, 2**17), (1, 1), (4096, 2**12)):
        monkeypatch.setattr(screen_tiles, "_BAND", band)
        monkeypatch.setattr(screen_tiles, "_CHUNK", chunk)
        parts = draw_ellipses(found, 137, 101)
        assert np.abs(parts - whole)[..., :4].mean() < 1e-5  # depths are told apart within a band's own range
        assert (np.abs(parts - whole)[..., :4].max(axis=-1) > 1e-3).mean() < 1e-3


def test_a_picture_of_nothing_is_empty() -> None:
    box = car_box()
    for center in ([0.0, 0.0, -9.0], [60.0, 0.0, 9.0], [0.0, -1e6, 9.0]):
        placed = Box3D(torch.tensor([center], dtype=torch.float64), box.size, box.rotation)
        image = draw_ellipses(ellipses(surface_cloud(), FAR, placed), 48, 48)
        assert image.shape == (48, 48, 5)
        assert not image.any()
