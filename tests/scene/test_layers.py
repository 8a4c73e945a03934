"""Merging objects by distance: against a loop over samples, on random segments and on real cars in each other."""

import numpy as np
import pytest
import torch

from carstudio import load_model
from carstudio.geometry.camera import Camera
from carstudio.models.interface import CategoryModel
from carstudio.rendering.rays import image_rays, to_canonical
from carstudio.rendering.volume import Segments
from carstudio.scene.layers import (
    ObjectLayer,
    TracedObject,
    bands,
    merge_layers,
    partial_segments,
    ray_lengths,
    trace_object,
)
from oracles.layers import merge_layers_plainly
from scene.toy_log import HEIGHT_M, SIZE, latents, placed

CAMERA = Camera(torch.tensor([120.0, 120.0, 80.0, 40.0]), 160, 96)


@pytest.fixture(scope="module")
def model():
    return load_model("car-gaussians").eval()


def random_object(seed: int, count: int, most: int) -> TracedObject:
    random = torch.Generator().manual_seed(seed)
    pixels = torch.randperm(count, generator=random)[: count * 2 // 3].sort().values
    shape = (1, len(pixels), most)
    distance = (torch.rand(shape, generator=random) * 10 + 5).sort(dim=-1).values
    alpha = torch.rand(shape, generator=random) * (torch.rand(shape, generator=random) > 0.3)
    return TracedObject(pixels, Segments(distance, distance * 0.9, alpha, torch.rand(*shape, 3, generator=random)))


def dense(layer: ObjectLayer, values: torch.Tensor, count: int) -> torch.Tensor:
    return torch.zeros(count, *values.shape[1:]).index_copy(0, layer.pixels, values)


def compare(objects: list[TracedObject], background: torch.Tensor) -> tuple[ObjectLayer, ...]:
    layers = merge_layers(objects, background)
    weights, rgb = merge_layers_plainly(objects, background)
    count = len(background)
    for number, layer in enumerate(layers):
        torch.testing.assert_close(dense(layer, layer.weight, count).double(), weights[number], atol=1e-5, rtol=0)
    total = sum(dense(layer, layer.rgb, count) for layer in layers)
    torch.testing.assert_close(total.double(), rgb, atol=1e-5, rtol=0)  # float32 sums of up to 96 weights
    return layers


def test_random_segments_of_three_objects_and_a_background():
    objects = [random_object(seed, 60, most) for seed, most in ((1, 4), (2, 7), (3, 1))]
    background = torch.rand(60, generator=torch.Generator().manual_seed(4)) * 12 + 5
    background[::4] = torch.inf
    layers = compare(objects, background)
    for layer, traced in zip(layers, objects, strict=True):
        assert sorted(layer.pixels.tolist()) == traced.pixels.tolist()
        assert bool((layer.weight <= layer.alone + 1e-6).all())


def test_the_order_of_objects_changes_nothing():
    objects = [random_object(seed, 60, 5) for seed in (5, 6, 7)]
    background = torch.full((60,), 12.0)
    forward, backward = merge_layers(objects, background), merge_layers(objects[::-1], background)[::-1]
    for one, other in zip(forward, backward, strict=True):
        torch.testing.assert_close(dense(one, one.rgb, 60), dense(other, other.rgb, 60), atol=1e-6, rtol=0)


def test_two_cars_in_each_other_merge_sample_by_sample(model):
    camera = CAMERA.resize(40, 24)
    boxes = [placed(0.0, 9.0), placed(0.5, 10.0, 0.3)]
    objects = [trace_object(model, latents(i), box.box(), camera) for i, box in enumerate(boxes)]
    layers = compare(objects, torch.full((40 * 24,), 10.5))
    both = dense(layers[0], layers[0].weight, 960) * dense(layers[1], layers[1].weight, 960)
    assert int((both > 0.01).sum()) > 10  # they do share pixels: painter's order would give one of them all


def test_nothing_to_merge():
    assert merge_layers([], torch.full((5,), 3.0)) == ()
    (layer,) = merge_layers([random_object(1, 60, 3)], torch.full((60,), 0.1))
    assert float(layer.weight.abs().max()) < 2e-6  # all behind the background, which lets a millionth through


def opacity_of(traced: TracedObject, offset: int = 0) -> torch.Tensor:
    result = torch.zeros(160 * 96, dtype=torch.float64)
    result[traced.pixels + offset] = 1 - (1 - traced.segments.alpha[0].double()).prod(dim=-1)
    return result.view(96, 160)


def test_traced_pixels_are_the_models_own_and_strips_change_nothing(model):
    box = placed(1.0, 8.0).box()
    whole = trace_object(model, latents(0), box, CAMERA)
    assert len(set(whole.pixels.tolist())) == len(whole.pixels)
    full = model.trace(image_rays(CAMERA), latents(0), box)
    opacity = (1 - (1 - full.alpha[0].double()).prod(dim=-1)).view(96, 160)
    hit = to_canonical(image_rays(CAMERA), box).hit.view(1, 1, 96, 160).float()
    inside = (-torch.nn.functional.max_pool2d(-hit, 3, 1, 1))[0, 0] > 0
    assert int(inside.sum()) > 300
    # the pixel's footprint is a mean over the rays in question, which are not the same ones
    torch.testing.assert_close(opacity_of(whole)[inside], opacity[inside], atol=2e-3, rtol=0)
    strips = torch.zeros(96, 160, dtype=torch.float64)
    for top, band in bands(CAMERA, 20):
        strips += opacity_of(trace_object(model, latents(0), box, band), top * 160)
    torch.testing.assert_close(strips, opacity_of(whole), atol=2e-3, rtol=0)


def test_at_the_rim_weights_are_those_of_the_covered_share():
    whole = random_object(8, 60, 6)
    share = torch.rand(len(whole.pixels), generator=torch.Generator().manual_seed(1))
    share[::3] = 1.0
    part = TracedObject(whole.pixels, partial_segments(whole.segments, share))
    nothing = torch.full((60,), torch.inf)
    (all_of,), (some,) = merge_layers([whole], nothing), merge_layers([part], nothing)
    torch.testing.assert_close(some.weight, all_of.weight * share, atol=1e-5, rtol=0)
    torch.testing.assert_close(some.rgb, all_of.rgb * share[:, None], atol=1e-5, rtol=0)


def test_the_rim_covers_what_the_box_covers():
    """The sum of the shares is the area of the box's outline: its near face seen straight on, and a strip of roof."""
    box = placed(0.0, 12.0).box()
    seen = trace_object(OpaqueModel(), latents(0), box, CAMERA)
    face = 120**2 * 1.8 * 1.5 / 100  # 10 m away
    near, far = 120 * 0.15 / 10, 120 * 0.15 / 14  # px from the horizon to the roof's edges, 0.15 m below the camera
    roof = (near - far) * (120 * 1.8 / 10 + 120 * 1.8 / 14) / 2
    assert float(seen.segments.alpha.sum()) == pytest.approx(face + roof, rel=0.005)


class OpaqueModel(CategoryModel):
    """Fills its box: one segment of alpha 1 on every ray."""

    tile_px, chunk_rays = 1, 10_000

    def trace(self, rays, latents, box) -> Segments:
        one = torch.ones(*rays.directions.shape[:2], 1)
        return Segments(one * 10, one * 10, one, one[..., None].expand(-1, -1, -1, 3))


def test_a_car_behind_the_camera_or_beside_it_gives_nothing(model):
    for box in (placed(0.0, -9.0), placed(60.0, 9.0)):
        assert len(trace_object(model, latents(0), box.box(), CAMERA).pixels) == 0


def test_a_car_around_the_camera_and_one_cut_by_the_border_are_traced(model):
    for box in (placed(0.3, 1.0), placed(-5.5, 8.0)):
        traced = trace_object(model, latents(0), box.box(), CAMERA)
        assert bool(traced.segments.alpha.isfinite().all())
        assert len(traced.pixels) > 0


def alone(model, z: float, x: float = 0.0) -> torch.Tensor:
    traced = trace_object(model, latents(3), placed(x, z).box(), CAMERA)
    (layer,) = merge_layers([traced], torch.full((160 * 96,), torch.inf))
    return dense(layer, layer.alone, 160 * 96).view(96, 160)


def test_as_opaque_at_40_m_as_at_5_m(model):
    near, far = alone(model, 5.0), alone(model, 40.0)
    assert float(near.max()) > 0.98
    assert float(far.max()) > 0.95


def test_a_car_that_drives_away_shrinks_smoothly(model):
    """No flicker: what it covers, times the square of its distance, hardly changes from frame to frame."""
    areas = [float(alone(model, z).sum()) * z**2 for z in np.arange(20.0, 30.0, 0.37)]
    steps = np.abs(np.diff(areas)) / np.array(areas[1:])
    assert steps.max() < 0.04  # of a car 6 to 9 px wide; 0.17 when the box cut it off at whole pixels


def test_half_a_pixel_would_be_seen(model):
    """A car seen right from behind is symmetric, so its silhouette's centre is the principal point's column."""
    weight = alone(model, 12.0)
    columns = torch.arange(160) + 0.5
    assert float((weight * columns).sum() / weight.sum()) == pytest.approx(80.0, abs=0.05)
    rows = (weight > 0.5).any(dim=1).nonzero()[:, 0]
    top_m = HEIGHT_M - SIZE[1]  # the box's top and bottom at its near face, which the car must stay within
    assert int(rows.min()) + 1 >= 40 + 120 * top_m / 10.0
    assert int(rows.max()) <= 40 + 120 * HEIGHT_M / 10.0


def test_ray_lengths_are_distance_per_depth():
    x, y = (100.5 - 80) / 120, (90.5 - 40) / 120
    expected = float(np.sqrt(1 + x * x + y * y))
    assert float(ray_lengths(CAMERA)[90 * 160 + 100]) == pytest.approx(expected, rel=1e-6)
