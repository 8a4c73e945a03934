from collections import Counter
from statistics import fmean, stdev

import pytest
import torch
from torch import Tensor

from carstudio.dataset.pixels import PatchCache, mirror_patch, prepare_patch
from carstudio.dataset.store import PatchStore
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.transforms import rotation_y
from carstudio.rendering.gaussians.cloud import GaussianCloud, splats_of
from carstudio.rendering.gaussians.tiles import tile_classes
from carstudio.rendering.rays import to_canonical
from carstudio.training.batches import (
    HEADING_NOISE_DEG,
    PLACE_NOISE,
    SIZE_NOISE,
    PixelDraws,
    StepSampler,
    generator_for,
    noisy_box,
    pixel_batch,
)
from rendering.gaussian_scenes import random_cloud
from training.toy import SIDE_PX, toy_store


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store")


def sampler(store: PatchStore, supervision: str = "single-view", seed: int = 0) -> StepSampler:
    cache = PatchCache(store, 32)
    return StepSampler(cache, store.patch_ids(), patches_per_step=5, supervision=supervision, seed=seed)  # type: ignore[arg-type]


def test_every_patch_is_encoded_once_per_epoch(store: PatchStore) -> None:
    drawn = [patch_id for step in range(12) for patch_id in sampler(store).input_ids(step)]  # 60 = 5 epochs of 12
    assert len(store.patch_ids()) == 12
    for epoch in range(5):
        assert Counter(drawn[12 * epoch : 12 * epoch + 12]) == Counter(store.patch_ids())
    assert drawn[:12] != drawn[12:24]


def test_a_step_is_the_same_whoever_asks_and_whenever(store: PatchStore) -> None:
    walked, jumped = sampler(store), sampler(store)
    for step in range(7):
        walked.batch(step, 16)
    a, b = walked.batch(7, 16), jumped.batch(7, 16)
    assert a[0].instance_ids == b[0].instance_ids
    assert torch.equal(a[1].rgb, b[1].rgb)
    assert torch.equal(a[1].rays.directions, b[1].rays.directions)
    assert not torch.equal(a[1].rgb, jumped.batch(8, 16)[1].rgb)


def test_supervision_chooses_the_target(store: PatchStore) -> None:
    single, multi, mixed = (sampler(store, kind) for kind in ("single-view", "multi-view", "mixed"))
    same = 0
    for step in range(40):
        inputs = single.input_ids(step)
        assert single.target_ids(step, inputs) == inputs
        others = multi.target_ids(step, inputs)
        assert all(a != b for a, b in zip(inputs, others, strict=True))
        assert all(a.rsplit("-", 1)[0] == b.rsplit("-", 1)[0] for a, b in zip(inputs, others, strict=True))
        same += sum(a == b for a, b in zip(inputs, mixed.target_ids(step, inputs), strict=True))
    assert 70 <= same <= 130  # half of 200, four standard deviations


def test_streams_and_steps_do_not_share_numbers() -> None:
    draws = {
        tuple(torch.rand(4, generator=generator_for(seed, step, stream)).tolist())
        for seed in range(3)
        for step in range(20)
        for stream in ("epoch", "target", "pixels", "jitter", "mirror", "box")
    }
    assert len(draws) == 3 * 20 * 6


def test_pixels_carry_the_colour_that_stands_there(store: PatchStore) -> None:
    """Each drawn ray, projected back, must name a pixel whose colour and mask are the batch's."""
    prepared = prepare_patch(store.patch("toy-1-2"), 32)
    pixels = pixel_batch([prepared], 500, torch.Generator().manual_seed(0))
    at = prepared.camera.project(pixels.rays.directions[0])
    column, row = at[:, 0].floor().long(), at[:, 1].floor().long()
    assert torch.allclose(at - at.floor(), torch.full_like(at, 0.5), atol=1e-3)
    assert torch.allclose(pixels.rgb[0], prepared.rgb[row, column].float() / 255)
    assert torch.equal(pixels.alpha[0] == 1, prepared.mask[row, column] == 255)
    assert int(column.max()) > SIDE_PX * 3 // 4


def test_more_rays_than_pixels_is_no_problem(store: PatchStore) -> None:
    """Released code crashes when a patch has fewer pixels than rays."""
    prepared = prepare_patch(store.patch("toy-0-0"), 32)
    assert pixel_batch([prepared], 10_000, torch.Generator().manual_seed(0)).rgb.shape == (1, 10_000, 3)


def drawn_places(store: PatchStore, count: int, draws: PixelDraws, seed: int) -> tuple[Tensor, Tensor]:
    """Columns and rows of drawn pixels."""
    prepared = prepare_patch(store.patch("toy-1-2"), 32)
    pixels = pixel_batch([prepared], count, torch.Generator().manual_seed(seed), draws)
    column, row = prepared.camera.project(pixels.rays.directions[0]).floor().long().unbind(-1)
    return column, row


def test_one_pixel_from_each_cell_and_the_rest_anywhere(store: PatchStore) -> None:
    column, row = drawn_places(store, 70, "in-cells", seed=3)
    in_cells = torch.stack([row[:64] * 8 // SIDE_PX, column[:64] * 8 // SIDE_PX], dim=-1)  # 8 x 8 cells of whole pixels
    assert SIDE_PX % 8 == 0
    tiles = [(top, left) for top in (0, 4) for left in (0, 4)]
    assert in_cells.tolist() == [[top + i // 4, left + i % 4] for top, left in tiles for i in range(16)]
    assert len(set(zip(row.tolist(), column.tolist(), strict=True))) > 60
    assert not torch.equal(column[64:], drawn_places(store, 70, "in-cells", seed=4)[0][64:])


def test_pixels_drawn_from_cells_come_in_tiles_of_rays(store: PatchStore) -> None:
    """What is drawn `in-cells` is tried tile by tile, each with some Gaussians; what is drawn anywhere is not."""
    patches = [prepare_patch(store.patch(f"toy-1-{view}"), 32) for view in range(3)]
    cloud, found = random_cloud(60, torch.float32), []
    splats = splats_of(GaussianCloud(*(part.expand(3, *part.shape[1:]) for part in list(vars(cloud).values())[:5])))
    ways: tuple[PixelDraws, PixelDraws] = ("in-cells", "anywhere")
    for draws in ways:
        drawn = pixel_batch(patches, 256, torch.Generator().manual_seed(0), draws)
        canonical = to_canonical(drawn.rays, drawn.box)
        found.append(tile_classes(splats, canonical.origins, canonical.view_directions))
    in_cells, anywhere = found
    assert in_cells is not None
    assert sum(int((one.splats < 60).sum()) for one in in_cells) < 0.6 * 3 * 16 * 60
    assert anywhere is None


def test_cells_draw_all_pixels_equally_often_and_means_with_less_noise(store: PatchStore) -> None:
    """49 cells of fractions of pixels; the mean of a smooth function over the crop is known."""
    counts = torch.zeros(SIDE_PX, SIDE_PX)
    means: dict[PixelDraws, list[float]] = {"anywhere": [], "in-cells": []}
    for seed in range(600):
        for draws, found in means.items():
            column, row = drawn_places(store, 49, draws, seed)
            found.append(float((column + 2 * row).float().mean()))
            if draws == "in-cells":
                counts.index_put_((row, column), torch.ones(49), accumulate=True)
    expected = 600 * 49 / SIDE_PX**2
    assert float(((counts - expected) ** 2 / expected).sum()) < SIDE_PX**2 + 5 * (2 * SIDE_PX**2) ** 0.5  # chi-square
    truth = 1.5 * (SIDE_PX - 1)
    for found in means.values():
        assert abs(fmean(found) - truth) < 4 * stdev(found) / 600**0.5
    assert stdev(means["in-cells"]) < 0.3 * stdev(means["anywhere"])


def test_the_cache_forgets_the_oldest_and_changes_nothing(store: PatchStore) -> None:
    full, tight = PatchCache(store, 32), PatchCache(store, 32, max_bytes=20_000)
    for patch_id in [*store.patch_ids(), *store.patch_ids()]:
        assert torch.equal(full[patch_id].encoder_image, tight[patch_id].encoder_image)
    assert len(tight._patches) < len(full._patches) == 12


def test_encoder_camera_sees_the_resized_crop(store: PatchStore) -> None:
    prepared = prepare_patch(store.patch("toy-0-1"), 80)  # twice the crop
    corner = torch.tensor([[1.0, 0.5, 5.0]])
    assert torch.allclose(prepared.encoder_camera.project(corner), 2 * prepared.camera.project(corner), atol=1e-4)


def test_a_mirrored_patch_is_the_flipped_photo_of_the_mirrored_car(store: PatchStore) -> None:
    """A point of the car has the colour that its mirror image has in the flipped photo, in crop and encoder image."""
    patch = prepare_patch(store.patch(store.patch_ids()[0]), 32)
    mirrored = mirror_patch(patch)
    points = torch.tensor([[1.2, 0.1, 0.4], [-0.8, -0.2, -0.6], [0.0, 0.0, 0.0]])
    for name, camera in (("rgb", "camera"), ("encoder_image", "encoder_camera")):
        seen = []
        for photo, side in ((patch, 1.0), (mirrored, -1.0)):
            in_camera = points * torch.tensor([1.0, 1.0, side]) @ photo.box.rotation.mT + photo.box.center
            column, row = getattr(photo, camera).project(in_camera).floor().long().unbind(-1)
            pixels = getattr(photo, name)
            seen.append(pixels[row, column] if name == "rgb" else pixels[:, row, column].mT)
        assert torch.equal(*seen), name
    assert torch.equal(mirror_patch(mirrored).rgb, patch.rgb)
    assert torch.equal(mirrored.mask, patch.mask.flip(1))


def test_mirroring_flips_half_of_the_photos_together_or_apart(store: PatchStore) -> None:
    cache = PatchCache(store, 32)
    drawn = {}
    for mirroring in ("off", "together", "apart"):
        sampled = StepSampler(
            cache, store.patch_ids(), patches_per_step=5, supervision="single-view", seed=0, mirroring=mirroring
        )
        drawn[mirroring] = [pair for step in range(80) for pair in sampled.mirrored(step)]
        patches, pixels = sampled.batch(3, 16)
        same = torch.isclose(patches.box.rotation, pixels.box.rotation).flatten(1).all(dim=-1).tolist()
        assert same == [a == b for a, b in sampled.mirrored(3)]
    assert set(drawn["off"]) == {(False, False)}
    assert set(drawn["together"]) == {(False, False), (True, True)}
    assert set(drawn["apart"]) == {(a, b) for a in (False, True) for b in (False, True)}
    assert 160 <= sum(pair[0] for pair in drawn["together"]) <= 240  # half of 400, four standard deviations


def test_photos_of_cars_without_another_are_mirrored_apart(store: PatchStore) -> None:
    """A car of one photo explains itself, so its mirror image stands for the side that is not seen."""
    cache, patch_ids = PatchCache(store, 32), store.patch_ids()
    car = dict(zip(*(store.table([name])[name].to_pylist() for name in ("patch_id", "instance_id")), strict=True))
    several = [name for name in patch_ids if car[name] == car[patch_ids[0]]]
    alone = next(name for name in patch_ids if car[name] != car[patch_ids[0]])
    assert len(several) > 1
    drawn: dict[bool, set[tuple[bool, bool]]] = {True: set(), False: set()}
    sampler = StepSampler(
        cache, [*several, alone], patches_per_step=5, supervision="mixed", seed=0, mirroring="apart-where-alone"
    )
    for step in range(60):
        for name, pair in zip(sampler.input_ids(step), sampler.mirrored(step), strict=True):
            drawn[name == alone].add(pair)
    assert drawn == {True: {(a, b) for a in (False, True) for b in (False, True)}, False: {(False, False)}}


def test_rough_boxes_are_those_of_encoded_photos_alone(store: PatchStore) -> None:
    """Same photos, pixels and rays; each photo's box is its own and the same whoever asks."""
    cache = PatchCache(store, 32)
    plain, rough, again = (
        StepSampler(cache, store.patch_ids(), patches_per_step=5, supervision="single-view", seed=0, box_noise=noise)
        for noise in (0.0, 1.0, 1.0)
    )
    (shown, explained), (moved, same) = plain.batch(3, 16), rough.batch(3, 16)
    assert torch.equal(shown.image, moved.image)
    assert torch.equal(explained.rgb, same.rgb)
    assert torch.equal(explained.box.center, same.box.center)
    assert not torch.equal(shown.box.center, moved.box.center)
    assert torch.equal(again.batch(3, 16, range(2, 4))[0].box.center, moved.box.center[2:4])


def test_how_rough_they_are() -> None:
    """Of 4,000 boxes: the scale is uniform in [0, 2], so a variance is 4/3 of the stated one; all stay rotations."""
    box = Box3D(torch.tensor([1.0, 0.5, 12.0]), torch.tensor([4.0, 1.5, 1.8]), rotation_y(torch.tensor(0.7)))
    generator = torch.Generator().manual_seed(0)
    boxes = [noisy_box(box, 1.0, generator) for _ in range(4000)]
    shift = torch.stack([(b.center - box.center) @ box.rotation / box.size for b in boxes])
    turn = torch.stack([torch.rad2deg(b.yaw_rad - box.yaw_rad) for b in boxes])
    growth = torch.stack([(b.size / box.size).log() for b in boxes])
    for values, deviation in ((shift, PLACE_NOISE), (turn, HEADING_NOISE_DEG), (growth, SIZE_NOISE)):
        assert values.mean(dim=0).abs().max() < 0.08 * deviation
        assert torch.allclose(values.std(dim=0), torch.tensor(deviation * (4 / 3) ** 0.5), rtol=0.06)
    turned = torch.stack([b.rotation for b in boxes])
    assert torch.allclose(turned @ turned.mT, torch.eye(3).expand(4000, 3, 3), atol=1e-5)
    assert torch.equal(noisy_box(box, 0.0, generator).size, box.size)
