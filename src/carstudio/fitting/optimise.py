"""Test-time optimisation (Car-Studio section IV-C): latents, and if asked the model, fitted to given photographs.

Latents start where the encoder puts them. Which pixels a step sees and what it wants of them arrive as functions.
Boxes may be refined along with them (`boxes`).
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from carstudio.errors import InputError
from carstudio.fitting.boxes import BoxFreedom, BoxMoves, moved_boxes, prior_of
from carstudio.geometry.box3d import Box3D
from carstudio.models.interface import CategoryModel, Latents
from carstudio.progress import Report, silent
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Rendering


@dataclass(frozen=True)
class FitConfig:
    """How a car is fitted."""

    steps: int = 100
    """Steps; 0 keeps the encoder's latents."""
    latent_rate: float = 1e-2
    """Learning rate of the latents (Adam)."""
    field_rate: float = 0.0
    """Learning rate of the model's own weights (its `field_parameters`); 0: they stay as they are, to the bit."""
    patience: int = 5
    """Stop after so many looks at the held-out pixels without a better one; the best is kept."""
    look_every: int = 10
    """Steps between looks at the held-out pixels."""
    hold_out_views: int = 0
    """Photographs of a car that no step shows, so that they tell when to stop; at least one is always shown. 0, and for
    a car of one photograph: other pixels of the shown ones tell, which do not notice a fit to these views alone. One
    view gains where the field is fitted and loses where codes alone are, which overfit late (docs/experiments.md)."""
    box: BoxFreedom = field(default_factory=BoxFreedom)
    """Whether boxes are refined too."""

    def __post_init__(self) -> None:
        if self.steps < 0 or self.latent_rate < 0 or self.field_rate < 0 or min(self.patience, self.look_every) < 1:
            raise InputError("fit: steps and rates must be 0 or more, patience and looks at least 1")
        if self.hold_out_views < 0:
            raise InputError(f"fit: hold-out-views must be 0 or more, found {self.hold_out_views}")
        if self.hold_out_views and (self.box.refine_pose or self.box.refine_size):
            raise InputError(
                "fit: boxes of views that no step shows cannot be refined; take either hold-out-views, or refine-pose "
                "and refine-size"
            )


@dataclass(frozen=True)
class FitPixels:
    """Rays of some photographs, what they show, and the car (row of the latents) each photograph is of.

    Photographs come in the same order at every step, where boxes are refined.
    """

    rays: Rays
    box: Box3D
    rgb: Float[Tensor, "photo ray 3"]
    alpha: Float[Tensor, "photo ray"]
    counts: Bool[Tensor, "photo ray"]
    car: Int[Tensor, " photo"]

    def select(self, rows: Bool[Tensor, " photo"]) -> "FitPixels":
        """Some of the photographs."""
        rays = Rays(self.rays.origins[rows], self.rays.directions[rows], self.rays.radii[rows])
        box = Box3D(self.box.center[rows], self.box.size[rows], self.box.rotation[rows])
        return FitPixels(rays, box, self.rgb[rows], self.alpha[rows], self.counts[rows], self.car[rows])


Curve = tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class Fitted:
    """Latents of all cars, changed weights (empty where the model stayed), steps that were made.

    `curves` are the held-out losses (steps done, value) of each car; `box` the refined boxes of all photographs, where
    boxes were refined.
    """

    latents: Latents
    weights: dict[str, Tensor]
    curves: tuple[Curve, ...]
    steps: int
    box: Box3D | None = None

    @property
    def curve(self) -> Curve:
        """Held-out losses of all cars together."""
        return tuple((points[0][0], sum(value for _, value in points)) for points in zip(*self.curves, strict=True))


Objective = Callable[[tuple[Rendering, ...], FitPixels], Float[Tensor, ""]]
Watch = Callable[[int, CategoryModel, Latents], None]


def fit(
    model: CategoryModel,
    start: Latents,
    draw: Callable[[int], FitPixels],
    objective: Objective,
    config: FitConfig,
    *,
    held_out: FitPixels | None = None,
    watch: Watch | None = None,
    report: Report = silent,
) -> Fitted:
    """Fit the latents of a batch of cars; `draw(step)` gives the pixels of a step.

    `objective` gets the renderings of all sampling levels and the pixels; where it is a sum over cars, a car's latents
    take the same steps alone as in company. The model given is left as it is; where `field_rate` is above 0 a copy is
    fitted and its changed weights are returned. `watch(steps done, model, latents)` sees the state before every step
    and after the last one.
    """
    if not model.is_coded and config.steps and not config.field_rate:
        raise InputError("this model has no codes to fit: it looks a car up in its photo; only its field can be fitted")
    if config.steps == 0:
        if watch is not None:
            watch(0, model, start)
        return Fitted(
            replace(start, shape=start.shape.detach().clone(), texture=start.texture.detach().clone()), {}, (), 0
        )
    fitted = copy.deepcopy(model) if config.field_rate else model
    weights = dict(fitted.field_parameters()) if config.field_rate else {}
    frozen = {name: p.requires_grad for name, p in fitted.named_parameters()}
    for name, parameter in fitted.named_parameters():
        parameter.requires_grad_(name in weights)
    try:
        state = _State(fitted, start, weights, draw(0), config.box)
        return _descend(state, draw, objective, config, held_out, watch, report)
    finally:
        for name, parameter in fitted.named_parameters():
            parameter.requires_grad_(frozen[name])


class _State:
    """All that a fit changes."""

    def __init__(
        self,
        model: CategoryModel,
        start: Latents,
        weights: dict[str, torch.nn.Parameter],
        pixels: FitPixels,
        freedom: BoxFreedom,
    ) -> None:
        self.model, self.weights, self.freedom = model, weights, freedom
        shape, texture = (code.detach().clone().requires_grad_() for code in (start.shape, start.texture))
        self.latents = Latents(shape, texture, start.pixels)
        self.photos, self.given = pixels.car, pixels.box
        self.moves = BoxMoves.none(len(pixels.car), len(start.shape), start.shape)
        self.moves.photo.requires_grad_(freedom.refine_pose)
        self.moves.car.requires_grad_(freedom.refine_size)

    @property
    def moves_boxes(self) -> bool:
        return self.freedom.refine_pose or self.freedom.refine_size

    def tensors(self) -> list[Tensor]:
        """Codes of shape and texture, moves by photograph, moves by car, then the weights."""
        return [*self.codes, self.moves.photo, self.moves.car, *self.weights.values()]

    @property
    def codes(self) -> list[Tensor]:
        return [self.latents.shape, self.latents.texture]

    def groups(self, config: FitConfig) -> list[dict[str, Any]]:
        groups: list[dict[str, Any]] = [{"params": self.codes, "lr": config.latent_rate}]
        if self.weights:
            groups.append({"params": list(self.weights.values()), "lr": config.field_rate})
        moved = [part for part in (self.moves.photo, self.moves.car) if part.requires_grad]
        return groups + ([{"params": moved, "lr": config.box.box_rate}] if moved else [])

    def loss(self, pixels: FitPixels, objective: Objective) -> Float[Tensor, ""]:
        renderings, pixels = self._shown(pixels)
        loss = objective(renderings, pixels)
        return loss + prior_of(self.moves, self.freedom) if self.moves_boxes else loss

    @torch.no_grad()
    def loss_of_each(self, pixels: FitPixels, objective: Objective) -> list[float]:
        """Losses of the cars, each by itself, without priors."""
        renderings, pixels = self._shown(pixels)
        values = []
        for car in range(len(self.latents.shape)):
            rows = pixels.car == car
            own = tuple(select_rows(rendering, rows) for rendering in renderings)
            values.append(float(objective(own, pixels.select(rows))))
        return values

    def _shown(self, pixels: FitPixels) -> tuple[tuple[Rendering, ...], FitPixels]:
        box = pixels.box
        if self.moves_boxes:
            box = moved_boxes(box, pixels.car, self.moves, self.freedom)
            pixels = replace(pixels, box=Box3D(box.center.detach(), box.size.detach(), box.rotation.detach()))
        of_photos = self.latents.select(pixels.car)
        return self.model.render_levels(pixels.rays, of_photos, box), pixels

    def fitted(self, best: "_Best", steps: int) -> Fitted:
        shape, texture, photo, car, *weights = best.tensors
        moves = BoxMoves(photo, car)
        return Fitted(
            Latents(shape, texture, self.latents.pixels),
            dict(zip(self.weights, weights, strict=True)),
            tuple(tuple(curve) for curve in best.curves),
            steps,
            moved_boxes(self.given, self.photos, moves, self.freedom) if self.moves_boxes else None,
        )


def _descend(
    state: _State,
    draw: Callable[[int], FitPixels],
    objective: Objective,
    config: FitConfig,
    held_out: FitPixels | None,
    watch: Watch | None,
    report: Report,
) -> Fitted:
    optimizer = torch.optim.Adam(state.groups(config))
    best = _Best(state, config.patience)
    done = 0
    for step in range(config.steps):
        if watch is not None:
            watch(step, state.model, state.latents)
        if held_out is not None and step % config.look_every == 0:
            best.look(step, state.loss_of_each(held_out, objective))
            if best.is_past:
                break
        loss = state.loss(draw(step), objective)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        done = step + 1
        report("fitting", done, config.steps, f"loss {float(loss.detach()):.4f}")
    if watch is not None and done == config.steps:
        watch(done, state.model, state.latents)
    if held_out is None:
        best.take_all()
    elif not best.is_past:
        best.look(done, state.loss_of_each(held_out, objective))
    return state.fitted(best, done)


def known_hits(pixels: FitPixels) -> Bool[Tensor, "photo ray"]:
    """Rays that count: their pixel is known and they hit the box."""
    return pixels.counts & to_canonical(pixels.rays, pixels.box).hit


def select_rows(rendering: Rendering, rows: Tensor) -> Rendering:
    """Some batch entries of a rendering."""
    return Rendering(**{part.name: getattr(rendering, part.name)[rows] for part in fields(Rendering)})


class _Best:
    """What explained the held-out pixels best: of each car by itself, or of all together where they share the field."""

    def __init__(self, state: _State, patience: int) -> None:
        self.state, self.patience = state, patience
        num_cars = len(state.latents.shape)
        self.curves: list[list[tuple[int, float]]] = [[] for _ in range(num_cars)]
        self.groups = [range(num_cars)] if state.weights else [range(car, car + 1) for car in range(num_cars)]
        self.values, self.misses = [math.inf] * len(self.groups), [0] * len(self.groups)
        self.take_all()

    @property
    def is_past(self) -> bool:
        """Whether no car has become better for long."""
        return all(misses >= self.patience for misses in self.misses)

    def look(self, step: int, losses: list[float]) -> None:
        for curve, loss in zip(self.curves, losses, strict=True):
            curve.append((step, loss))
        for index, group in enumerate(self.groups):
            value = sum(losses[car] for car in group)
            if self.misses[index] >= self.patience:
                continue  # alone, this one would have stopped
            if value < self.values[index]:
                self.values[index], self.misses[index] = value, 0
                self._take(group)
            else:
                self.misses[index] += 1

    def take_all(self) -> None:
        self.tensors = [tensor.detach().clone() for tensor in self.state.tensors()]

    def _take(self, group: range) -> None:
        if self.state.weights:
            self.take_all()
            return
        photos = torch.isin(self.state.photos, torch.tensor(list(group), device=self.state.photos.device))
        for place, (kept, now) in enumerate(zip(self.tensors, self.state.tensors(), strict=True)):
            rows = photos if place == 2 else slice(group.start, group.stop)
            kept[rows] = now.detach()[rows]
