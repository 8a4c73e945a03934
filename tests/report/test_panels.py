"""Turntables and sheets of a model at work, with a model whose pictures are known: a solid box, its front half red."""

from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import PatchStore
from carstudio.evaluation.protocols import EvaluationConfig, score_views, view_pairs
from carstudio.geometry.box3d import Box3D
from carstudio.images import read_image
from carstudio.models.interface import CategoryModel, Latents, PatchBatch
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Segments
from carstudio.report.colours import NO_DEPTH, colour_depth, turbo
from carstudio.report.panels import encode_patch, truth_on_black, turntable, views_panel, views_sheet
from training.toy import toy_store

SIZE = (4.2, 1.5, 1.8)


class SolidBox(CategoryModel):
    """One opaque segment where a ray enters the box: red before the middle, blue behind it."""

    encoder_side_px = 32

    def __init__(self) -> None:
        super().__init__()
        self.unused = torch.nn.Parameter(torch.zeros(1))

    def encode(self, patches: PatchBatch) -> Latents:
        """Nothing is looked at."""
        return Latents(patches.image.new_zeros(len(patches.image), 1), patches.image.new_zeros(len(patches.image), 1))

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        """The entry."""
        canonical = to_canonical(rays, box)
        x = canonical.origins[..., 0] + canonical.near * canonical.directions[..., 0]
        rgb = torch.stack([(x > 0).float(), torch.zeros_like(x), (x <= 0).float()], dim=-1)
        near = canonical.near[..., None]
        return (Segments(near, near * rays.directions[..., 2:], canonical.hit.float()[..., None], rgb[..., None, :]),)


@pytest.fixture(scope="module")
def turned() -> object:
    latents = Latents(torch.zeros(1, 1), torch.zeros(1, 1))
    box = Box3D(torch.zeros(1, 3), torch.tensor([SIZE]), torch.eye(3)[None])
    return turntable(SolidBox(), latents, box, views=4, size_px=64, elevation_deg=0.0)


def colour_shares(frame: np.ndarray) -> tuple[float, float, float]:
    """Mean column of red and blue pixels (nan without any) and the share of background."""
    columns = []
    for channel in (0, 2):
        others = [c for c in range(3) if c != channel]
        is_it = (frame[..., channel] > 200) & (frame[..., others] < 50).all(axis=-1)
        columns.append(float(np.nonzero(is_it)[1].mean()) if is_it.any() else float("nan"))
    return columns[0], columns[1], float((frame == 255).all(axis=-1).mean())


def test_a_car_turns_by_its_left_side(turned) -> None:
    """Front first; then from its left, where a car faces to the viewer's left; rear; then right."""
    front, left, rear, right = (colour_shares(frame) for frame in turned.rgb)
    assert np.isnan(front[1])
    assert front[0] == pytest.approx(31.5, abs=0.5)
    assert left[0] < 31.5 < left[1]
    assert np.isnan(rear[0])
    assert rear[1] == pytest.approx(31.5, abs=0.5)
    assert right[1] < 31.5 < right[0]
    assert all(share > 0.4 for *_, share in (front, left, rear, right))  # white around it


def test_the_car_has_its_width_in_the_picture(turned) -> None:
    """Bounding sphere over 95 % of the frame at 30 degrees: the front face's width in px, by hand."""
    radius = np.linalg.norm(SIZE) / 2
    distance = radius / (0.95 * np.sin(np.radians(15)))
    focal = 32 / np.tan(np.radians(15))
    expected = focal * SIZE[2] / (distance - SIZE[0] / 2)
    red = (turned.rgb[0] == (255, 0, 0)).all(axis=-1)
    assert np.ptp(np.nonzero(red)[1]) + 1 == pytest.approx(expected, abs=1.01)
    depth = distance - SIZE[0] / 2
    drawn = turned.depth[0][red]
    plain = colour_depth(np.full((1, 1), depth, np.float32), near_m=distance - radius, far_m=distance + radius)
    assert np.abs(drawn.astype(int) - plain[0, 0]).max() <= 2
    assert (turned.depth[0][~red] == NO_DEPTH).all()
    assert (turned.opacity[0][red] == turbo(np.ones((1, 1), np.float32))[0, 0]).all()
    assert (turned.opacity[0][~red] == turbo(np.zeros((1, 1), np.float32))[0, 0]).all()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "data", cars=2, views=2)


def test_truth_is_the_photo_on_the_car_and_black_elsewhere(store: PatchStore) -> None:
    patch = PatchCache(store, 32)[store.patch_ids()[0]]
    truth = truth_on_black(patch)
    is_car = (patch.mask == MaskValue.CAR).numpy()
    assert 0.05 < is_car.mean() < 0.95
    assert (truth[~is_car] == 0).all()
    assert (truth[is_car] == patch.rgb.numpy()[is_car]).all()


def test_a_sheet_has_a_row_per_view_with_its_scores(store: PatchStore) -> None:
    config = EvaluationConfig(protocol="novel-view", split=None, part="all", limit=3)
    views = list(score_views(SolidBox(), store, view_pairs(store, config)))
    one, three = views_sheet(views[:1]), views_sheet(views)
    assert one.shape[1] == three.shape[1] > 5 * 192
    assert three.shape[0] > 3 * 128
    first = views[0].input_patch.rgb.numpy()
    middle = one[8 + 21 + 64, 8 + 96]  # centre of the first tile: the input photo's centre pixels
    assert np.abs(middle.astype(int) - first[18:22, 18:22].reshape(-1, 3).mean(axis=0)).max() < 40


def test_the_panel_of_a_training_is_written(store: PatchStore, tmp_path: Path) -> None:
    views_panel(SolidBox(), store, tmp_path / "pictures" / "step.png", None, 2)
    picture = read_image(tmp_path / "pictures" / "step.png")
    assert picture.shape[0] > 2 * 128
    assert picture.std() > 10


def test_an_encoded_patch_comes_with_its_own_box(store: PatchStore) -> None:
    patch_id = store.patch_ids()[1]
    prepared, latents, box = encode_patch(SolidBox(), store, patch_id)
    assert prepared.patch_id == patch_id
    assert latents.shape.shape == (1, 1)
    assert torch.equal(box.center[0], prepared.box.center)
    assert torch.equal(box.rotation[0], prepared.box.rotation)
