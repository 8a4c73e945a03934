"""The two evaluation protocols, always named beside a figure.

`input-view`: the encoder sees the very patch that is scored (what the released code measured). `novel-view`: it sees
another view of the same car. Scores are per image, on the box crop at its own resolution.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch

from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.metrics import ImageScores, Lpips, score_image
from carstudio.evaluation.results import ResultRow
from carstudio.models.interface import CategoryModel, render_image
from carstudio.progress import Report, silent
from carstudio.training.batches import patch_batch, stack_boxes

Protocol = Literal["input-view", "novel-view"]


@dataclass(frozen=True)
class ViewPair:
    """The patch a model sees and the patch it is scored on, both of one car."""

    input_patch_id: str
    scored_patch_id: str
    instance_id: str


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """What is scored."""

    protocol: Protocol
    """input-view or novel-view."""
    split: str | None = "instance"
    """Split whose part is scored; None: all kept patches."""
    part: Literal["train", "test", "all"] = "test"
    """Part of the split."""
    limit: int | None = None
    """Score at most this many images, evenly spread over the store's order; None: all."""
    seed: int = 0
    """Chooses the input view of each scored view (novel-view)."""
    least_train_views: int = 0
    """Leave out cars with fewer photos in the split's training part."""


def view_pairs(store: PatchStore, config: EvaluationConfig) -> list[ViewPair]:
    """Which view is encoded for which scored view.

    novel-view draws the input evenly from the car's other views: from the training part in split `view` (its cars are
    known, its scored views are not), from the scored part otherwise. Cars without another view are left out.
    """
    scored = store.patch_ids(kept=True, split=config.split, part=config.part if config.split else "all")
    table = store.table(["patch_id", "instance_id"])
    instance_of = dict(zip(table["patch_id"].to_pylist(), table["instance_id"].to_pylist(), strict=True))
    if config.least_train_views:
        trained = Counter(instance_of[name] for name in store.patch_ids(kept=True, split=config.split, part="train"))
        scored = [name for name in scored if trained[instance_of[name]] >= config.least_train_views]
    if config.protocol == "input-view":
        pairs = [ViewPair(patch_id, patch_id, instance_of[patch_id]) for patch_id in scored]
    else:
        pairs = list(_novel_pairs(scored, _input_pool(store, config, scored), instance_of, config.seed))
    if not pairs:
        raise InputError(
            f"{store.path}: nothing to score for protocol {config.protocol}, split {config.split!r}, "
            f"part {config.part}; novel-view needs cars with at least two kept views"
        )
    if config.limit is not None and len(pairs) > config.limit:
        pairs = [pairs[i * len(pairs) // config.limit] for i in range(config.limit)]
    return pairs


def can_score(store: PatchStore, config: EvaluationConfig) -> bool:
    """Whether there is a view to score; novel-view needs a car with two."""
    try:
        return bool(view_pairs(store, config))
    except InputError:
        return False


def _input_pool(store: PatchStore, config: EvaluationConfig, scored: list[str]) -> list[str]:
    if config.split == "view" and config.part == "test":
        return store.patch_ids(kept=True, split="view", part="train")
    return scored


def _novel_pairs(scored: list[str], pool: list[str], instance_of: dict[str, str], seed: int) -> Iterator[ViewPair]:
    views: dict[str, list[str]] = {}
    for patch_id in pool:
        views.setdefault(instance_of[patch_id], []).append(patch_id)
    generator = torch.Generator().manual_seed(seed)
    for patch_id in scored:
        draw = float(torch.rand((), generator=generator))
        others = [view for view in views.get(instance_of[patch_id], []) if view != patch_id]
        if others:
            yield ViewPair(others[int(draw * len(others))], patch_id, instance_of[patch_id])


@dataclass(frozen=True)
class ScoredView:
    """One scored image with the pixels that led to the scores, for pictures."""

    pair: ViewPair
    input_patch: PreparedPatch
    scored_patch: PreparedPatch
    rgb: torch.Tensor  # (height, width, 3) in [0, 1], over black
    opacity: torch.Tensor
    depth_m: torch.Tensor
    scores: ImageScores


@torch.no_grad()
def score_views(
    model: CategoryModel,
    store: PatchStore,
    pairs: list[ViewPair],
    *,
    lpips: Lpips | None = None,
    report: Report = silent,
    description: str = "scoring",
    alter: Callable[[PreparedPatch], PreparedPatch] | None = None,
) -> Iterator[ScoredView]:
    """Encode, render at the crop's resolution and score each pair; `alter` changes what is encoded, to see the harm."""
    device = next(model.parameters()).device
    cache = PatchCache(store, model.encoder_side_px)
    model.eval()
    for done, pair in enumerate(pairs, start=1):
        shown, scored = cache[pair.input_patch_id], cache[pair.scored_patch_id]
        shown = alter(shown) if alter else shown
        latents = model.encode(patch_batch([shown]).to(device))
        image = render_image(model, scored.camera.to(device), latents, stack_boxes([scored.box]).to(device))
        rgb, opacity, depth = (image[name].cpu() for name in ("rgb", "opacity", "depth_m"))
        scores = score_image(rgb, opacity, scored.rgb.float() / 255, scored.mask, lpips=lpips)
        report(description, done, len(pairs), "")
        yield ScoredView(pair, shown, scored, rgb, opacity, depth, scores)


def result_row(
    view: ScoredView, config: EvaluationConfig, *, method: str, steps: int, data_sha256: str, checkpoint_sha256: str
) -> ResultRow:
    """The contract's row of a scored view; `split` reads NAME:part."""
    return ResultRow(
        method=method,
        protocol=config.protocol,
        split=f"{config.split}:{config.part}" if config.split else "none:all",
        instance_id=view.pair.instance_id,
        patch_id=view.pair.scored_patch_id,
        input_patch_id=view.pair.input_patch_id,
        psnr=view.scores.psnr,
        psnr_mask=view.scores.psnr_mask,
        ssim=view.scores.ssim,
        ssim_mask=view.scores.ssim_mask,
        lpips=view.scores.lpips,
        mask_iou=view.scores.mask_iou,
        seed=config.seed,
        steps=steps,
        data_sha256=data_sha256,
        checkpoint_sha256=checkpoint_sha256,
    )
