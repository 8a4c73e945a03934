"""The paper's learning curve (Car-Studio section IV-C): how views get better while cars are fitted at test time.

Cars are fitted to the training part of split `view` and scored on the other views, which no step has seen; the views
that were fitted are scored beside them, by name.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import torch

from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.metrics import score_image
from carstudio.evaluation.perceptual import Lpips
from carstudio.evaluation.protocols import EvaluationConfig, ScoredView, ViewPair, result_row
from carstudio.evaluation.results import ResultRow
from carstudio.fitting.optimise import FitConfig
from carstudio.geometry.orbit import viewing_angles
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.progress import Report, silent
from carstudio.training.batches import stack_boxes
from carstudio.training.patch_fitting import fit_cars

Views = Literal["held-out", "fitted"]
MARKS = (0, 5, 10, 20, 50, 100, 200)


@dataclass(frozen=True, kw_only=True)
class CurveConfig:
    """How cars are fitted and when they are scored."""

    marks: tuple[int, ...] = MARKS
    """Steps after which views are scored."""
    latent_rate: float = 1e-2
    """Learning rate of the latents."""
    field_rate: float = 0.0
    """Learning rate of the field; 0: it stays."""
    rays: int = 256
    """Pixels per photograph and step."""
    cars_per_batch: int = 8
    """Cars fitted together; where the field is fitted they share it."""
    held_out_views: int | None = None
    """Held-out views per car that are scored: from the nearest to a fitted one to the farthest around; None: all."""
    fitted_views: int = 2
    """Views per car that were fitted and are scored too."""
    split: str = "view"
    """Split by view: the training part is fitted, the test part scored."""
    seed: int = 0
    """Which pixels."""

    def __post_init__(self) -> None:
        if not self.marks or min(self.marks) < 0 or self.cars_per_batch < 1 or self.rays < 1:
            raise InputError("learning curve: expected marks of 0 or more, and at least one car and ray")


@dataclass(frozen=True)
class CurvePoint:
    """One view scored after some steps of fitting."""

    steps: int
    views: Views
    scored: ScoredView
    turned_deg: float = 0.0  # how far around the car from the nearest view that was fitted

    def row(self, config: CurveConfig, *, method: str, steps: int, data_sha256: str, sha256: str) -> dict[str, Any]:
        """The contract's row, with `fit_steps`, `fit_field` and `views` beside it."""
        protocol = EvaluationConfig(protocol="novel-view", split=config.split, part=_part(self.views), seed=config.seed)
        row: ResultRow = result_row(
            self.scored, protocol, method=method, steps=steps, data_sha256=data_sha256, checkpoint_sha256=sha256
        )
        if self.views == "fitted":
            row = replace(row, protocol="input-view")
        fits_field = config.field_rate > 0
        about = {"fit_steps": self.steps, "fit_field": fits_field, "views": self.views}
        return asdict(row) | about | {"turned_deg": round(self.turned_deg, 1)}


def _part(views: Views) -> Literal["train", "test"]:
    return "test" if views == "held-out" else "train"


@dataclass(frozen=True)
class FittableCar:
    """A car with views to fit and views to score."""

    instance_id: str
    fitted: tuple[str, ...]
    held_out: tuple[str, ...]


def fittable_cars(store: PatchStore, split: str = "view") -> list[FittableCar]:
    """Cars that have views on both sides of a split by view; `InputError` when there is none."""
    table = store.table(["patch_id", "instance_id", "box_center"])
    columns = (table[name].to_pylist() for name in ("patch_id", "instance_id", "box_center"))
    instance_of = {patch: car for patch, car, center in zip(*columns, strict=True) if center is not None}
    views: dict[str, dict[str, list[str]]] = {}
    for part in ("train", "test"):
        for patch in store.patch_ids(kept=True, split=split, part=part):
            if patch in instance_of:
                views.setdefault(instance_of[patch], {"train": [], "test": []})[part].append(patch)
    cars = [
        FittableCar(name, tuple(parts["train"]), tuple(parts["test"]))
        for name, parts in views.items()
        if parts["train"] and parts["test"]
    ]
    if not cars:
        raise InputError(f"{store.path}: no car has kept views on both sides of split {split!r}; see `dataset info`")
    return cars


def scored_views(car: FittableCar, cache: PatchCache, most: int | None) -> tuple[str, ...]:
    """The held-out views that are scored: all, or `most` of them, evenly by how far they turn from the fitted ones."""
    if most is None or len(car.held_out) <= most:
        return car.held_out
    fitted = [cache[patch] for patch in car.fitted]
    ranked = sorted(car.held_out, key=lambda patch: (turned_deg(cache[patch], fitted), patch))
    last = len(ranked) - 1
    return tuple(ranked[round(i * last / max(1, most - 1))] for i in range(most))


OnFitted = Callable[[FittableCar, CategoryModel, Latents], None]


@dataclass(frozen=True)
class _Snapshot:
    latents: Latents
    weights: dict[str, torch.Tensor]


def learning_curve(
    model: CategoryModel,
    store: PatchStore,
    cars: Sequence[FittableCar],
    config: CurveConfig,
    *,
    lpips: Lpips | None = None,
    on_fitted: OnFitted | None = None,
    report: Report = silent,
) -> list[CurvePoint]:
    """Fit the cars and score their views at each mark; with marks of 0 alone, zero-shot. The model stays as it is.

    `on_fitted(car, model, latents)` sees each car after the last mark.
    """
    cache = PatchCache(store, model.encoder_side_px)
    points: list[CurvePoint] = []
    for first in range(0, len(cars), config.cars_per_batch):
        batch = cars[first : first + config.cars_per_batch]
        points += _curve_of_batch(model, cache, batch, config, lpips, on_fitted)
        report("learning curve", first + len(batch), len(cars), "")
    return sorted(points, key=lambda point: point.steps)


def _curve_of_batch(
    model: CategoryModel,
    cache: PatchCache,
    cars: Sequence[FittableCar],
    config: CurveConfig,
    lpips: Lpips | None,
    on_fitted: OnFitted | None,
) -> list[CurvePoint]:
    snapshots: dict[int, _Snapshot] = {}

    def watch(step: int, model: CategoryModel, latents: Latents) -> None:
        if step in config.marks:
            weights = {name: p.detach().clone() for name, p in model.field_parameters()} if config.field_rate else {}
            snapshots[step] = _Snapshot(_copied(latents), weights)

    fit_config = FitConfig(steps=max(config.marks), latent_rate=config.latent_rate, field_rate=config.field_rate)
    photos = [[cache[patch] for patch in car.fitted] for car in cars]
    fit_cars(model, photos, fit_config, rays=config.rays, seed=config.seed, stops_early=False, watch=watch)
    points = []
    scored_of = {car.instance_id: scored_views(car, cache, config.held_out_views) for car in cars}
    for steps, snapshot in snapshots.items():
        shown = _with_weights(model, snapshot.weights)
        for index, car in enumerate(cars):
            latents = snapshot.latents.select(index)
            for patch in scored_of[car.instance_id] + car.fitted[: config.fitted_views]:
                scored = score_fitted(shown, latents, cache[car.fitted[0]], cache[patch], lpips)
                views: Views = "held-out" if patch in car.held_out else "fitted"
                points.append(CurvePoint(steps, views, scored, turned_deg(cache[patch], photos[index])))
            if on_fitted is not None and steps == max(config.marks):
                on_fitted(car, shown, latents)
    return points


def turned_deg(patch: PreparedPatch, others: Sequence[PreparedPatch]) -> float:
    """How far around the car a patch was taken from the nearest of the others, degrees."""
    azimuth = float(viewing_angles(patch.box)[0])
    around = [abs(math.remainder(azimuth - float(viewing_angles(other.box)[0]), 2 * math.pi)) for other in others]
    return math.degrees(min(around))


def _copied(latents: Latents) -> Latents:
    return replace(latents, shape=latents.shape.detach().clone(), texture=latents.texture.detach().clone())


def _with_weights(model: CategoryModel, weights: dict[str, torch.Tensor]) -> CategoryModel:
    if not weights:
        return model
    changed = copy.deepcopy(model)
    changed.load_state_dict(weights, strict=False)
    return changed


@torch.no_grad()
def score_fitted(
    model: CategoryModel,
    latents: Latents,
    shown: PreparedPatch,
    scored: PreparedPatch,
    lpips: Lpips | None = None,
) -> ScoredView:
    """One view of a car whose latents (a batch of one) are known; `shown` is a photograph that they come from."""
    device = latents.shape.device
    image = render_image(model, scored.camera.to(device), latents, stack_boxes([scored.box]).to(device))
    rgb, opacity, depth = (image[name].cpu() for name in ("rgb", "opacity", "depth_m"))
    scores = score_image(rgb, opacity, scored.rgb.float() / 255, scored.mask, lpips=lpips)
    pair = ViewPair(shown.patch_id, scored.patch_id, scored.instance_id)
    return ScoredView(pair, shown, scored, rgb, opacity, depth, scores)
