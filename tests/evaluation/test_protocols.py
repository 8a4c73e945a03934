from pathlib import Path

import numpy as np
import pytest
import torch

from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.protocols import EvaluationConfig, result_row, score_views, view_pairs
from carstudio.geometry.box3d import Box3D
from carstudio.models.interface import CategoryModel, Latents, PatchBatch
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Segments
from training.toy import toy_store


class TrueEllipsoid(CategoryModel):
    """The toy cars' exact shape: one opaque segment on the ellipsoid; the code is the input's mean colour."""

    encoder_side_px = 16

    def __init__(self) -> None:
        super().__init__()
        self.anchor = torch.nn.Parameter(torch.zeros(1))

    def encode(self, patches: PatchBatch) -> Latents:
        weight = patches.mask[:, None]
        colour = (patches.image * weight).sum(dim=(2, 3)) / weight.sum(dim=(2, 3))
        return Latents(colour[:, :0], colour)

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        canonical = to_canonical(rays, box)
        o, d = canonical.origins, canonical.directions
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        root = b * b - a * c
        distance = ((-b - root.clamp(min=0).sqrt()) / a)[..., None]
        rgb = latents.texture[:, None, None].expand(*distance.shape, 3)
        return (Segments(distance, distance * rays.directions[..., 2:], (root > 0).float()[..., None], rgb),)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> PatchStore:
    return toy_store(tmp_path_factory.mktemp("toy") / "store", cars=5, views=4)


def test_input_view_scores_what_it_encodes(store: PatchStore) -> None:
    pairs = view_pairs(store, EvaluationConfig(protocol="input-view", split=None))
    assert [pair.scored_patch_id for pair in pairs] == store.patch_ids()
    assert all(pair.input_patch_id == pair.scored_patch_id for pair in pairs)


def test_novel_view_encodes_another_view_of_the_same_unseen_car(store: PatchStore) -> None:
    pairs = view_pairs(store, EvaluationConfig(protocol="novel-view", split="instance", part="test"))
    trained = {patch_id.rsplit("-", 1)[0] for patch_id in store.patch_ids(split="instance", part="train")}
    assert len(pairs) == 4
    for pair in pairs:
        assert pair.input_patch_id != pair.scored_patch_id
        assert pair.input_patch_id.rsplit("-", 1)[0] == pair.scored_patch_id.rsplit("-", 1)[0] == pair.instance_id
        assert pair.instance_id not in trained


def test_split_view_encodes_a_training_view_and_scores_a_held_out_one(store: PatchStore) -> None:
    pairs = view_pairs(store, EvaluationConfig(protocol="novel-view", split="view", part="test"))
    train, test = (set(store.patch_ids(split="view", part=part)) for part in ("train", "test"))
    assert {pair.scored_patch_id for pair in pairs} == test
    assert all(pair.input_patch_id in train for pair in pairs)


def test_pairs_are_reproducible_and_limited_evenly(store: PatchStore) -> None:
    config = EvaluationConfig(protocol="novel-view", split=None)
    assert view_pairs(store, config) == view_pairs(store, config)
    other = view_pairs(store, EvaluationConfig(protocol="novel-view", split=None, seed=1))
    assert other != view_pairs(store, config)
    few = view_pairs(store, EvaluationConfig(protocol="novel-view", split=None, limit=5))
    assert {pair.instance_id for pair in few} == {f"toy-{car}" for car in range(5)}


def test_nothing_to_score_says_why(tmp_path: Path) -> None:
    single = toy_store(tmp_path / "single", cars=3, views=1)
    with pytest.raises(InputError, match="at least two kept views"):
        view_pairs(single, EvaluationConfig(protocol="novel-view", split=None))


def test_the_true_shape_scores_as_it_must(store: PatchStore) -> None:
    """Closed-form renderer against the toy photos: silhouettes agree to the pixel, camera and crop included."""
    config = EvaluationConfig(protocol="input-view", split=None)
    for view in score_views(TrueEllipsoid(), store, view_pairs(store, config)):
        assert view.scores.mask_iou == 1.0
        truth = np.where((view.scored_patch.mask == 255)[..., None], view.scored_patch.rgb.numpy() / 255.0, 0.0)
        mean_square = float(((view.rgb.numpy() - truth) ** 2).mean())
        assert view.scores.psnr == pytest.approx(-10 * np.log10(mean_square), abs=1e-3)
        row = result_row(view, config, method="true", steps=0, data_sha256="d", checkpoint_sha256="c")
        assert row.split == "none:all"
        assert row.patch_id == row.input_patch_id == view.pair.scored_patch_id
