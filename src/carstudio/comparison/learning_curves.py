"""`ttopt`: the paper's learning curve. Models trained on one store are fitted to cars of another and scored on the way.

NSG's object model, which has no prior, is trained on the very photos that the others are fitted to.
"""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from carstudio.comparison.budgets import Budget, within
from carstudio.comparison.curve_pictures import pictures_of, write_strip, write_view
from carstudio.comparison.curves import FIELD, FIELD_ALONE, LATENTS, NO_PRIOR, Curve, curve_table, turn_table
from carstudio.comparison.document import Document, write_document
from carstudio.comparison.rows import Row
from carstudio.comparison.running import Work, open_model, train_row
from carstudio.comparison.table import TITLES, facts_of
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.evaluation.learning_curve import CurveConfig, FittableCar, fittable_cars, learning_curve, scored_views
from carstudio.evaluation.perceptual import load_lpips
from carstudio.evaluation.tables import Table
from carstudio.files import parse_json, read_json, write_json, write_text
from carstudio.models.interface import CategoryModel, Latents
from carstudio.recipes import recipe, supervised
from carstudio.training.checkpoint import describe_model

FIELD_RATES = {"car-gaussians": 3e-3}  # numbers of Gaussians bear larger steps than weights of a network
USUAL_FIELD_RATE = 3e-4
SHOWN_CARS, CARS_PER_BATCH = 3, 8


def fitted_rows() -> list[Row]:
    """Models that can be fitted, trained by single-view supervision as for the zero-shot table."""
    titles = {
        "pixelnerf-mlp": "PixelNeRF-MLP",
        "autorf": "AutoRF",
        "code-nerf": "CodeNeRF",
        "car-nerf": "Car-NeRF",
        "car-gaussians": "Car-Gaussians",
    }
    return [_row(name, title) for name, title in titles.items()]


def scratch_rows() -> list[Row]:
    """NSG's object model, trained on the fitted photos alone."""
    return [_row("nsg", "NSG (7 samples, place)"), _row("nsg-fair", "NSG, fair (more samples, no place)")]


def _row(name: str, title: str) -> Row:
    return Row(name, title, replace(supervised(recipe(name), "single-view"), recipe=name))


def make_learning_curves(work: Work, fit_work: Work, rows: Sequence[Row], budget: Budget) -> list[Table]:
    """Train, fit and score what is missing; write `ttopt.md`, `.tex`, `.html`, pictures and `rows.jsonl`.

    `work` has the store that models are trained on, `fit_work` the one whose cars are fitted.
    """
    fitting, fitted = budget.fitting, fit_work.store
    cars = _some(fittable_cars(fitted, fit_work.split), fit_work.limit)
    rays = fitting.rays_per_photo(sum(len(car.fitted) for car in cars), len(cars))
    found, spent = [], []
    for done, row in enumerate(rows):
        work.report("ttopt", done, len(rows), row.name)
        is_scratch = row.name in {one.name for one in scratch_rows()}
        where = fit_work if is_scratch else work
        trained, summary = train_row(where, replace(row, config=within(budget, row.config)))
        spent.append((row, summary))
        for mode in _modes(where, row, is_scratch):
            with_field = mode in (FIELD, FIELD_ALONE)
            config = CurveConfig(
                marks=(0,) if is_scratch else fitting.marks,
                field_rate=FIELD_RATES.get(row.name, USUAL_FIELD_RATE) if with_field else 0.0,
                rays=rays,
                cars_per_batch=1 if with_field else CARS_PER_BATCH,  # a field that cars share mixes their unseen sides
                held_out_views=fitting.scored_views,
                fitted_views=fitting.fitted_views,
                split=fit_work.split,
                seed=work.seed,
            )
            found.append(_curve(where, fit_work, cars, trained, mode, config))
    work.report("ttopt", len(rows), len(rows), "")
    tables = [curve_table(found, "held-out", fitting.marks[-1]), curve_table(found, "fitted", fitting.marks[-1])]
    if fit_work.split != "view":
        tables.append(turn_table(found))
    which = f"{fitted.path.name}, sha256 {fitted.data_sha256[:16]}, split {fit_work.split}: {len(cars)} cars"
    spent_on = "; ".join(f"{curve.row.name}, {curve.mode} {curve.cpu_seconds:,.0f}" for curve in found)
    about = (
        *(fact for fact in facts_of(work, spent, budget) if fact[0] != "scored"),
        ("fitted cars", which),
        ("fitting", f"{fitting} ({rays} rays of each photo)"),
        ("field", "each car's own where it is fitted; NSG's is one for all cars, with a code for each"),
        ("cost of fitting", f"{spent_on} CPU-seconds"),
    )
    cache = PatchCache(fitted, 8)
    shown = shown_cars(cars, fitted)
    views = {car.instance_id: shown_view(car, cache, fitting.scored_views) for car in shown}
    pictures = pictures_of(found, shown, views, cache)
    write_document(Document("ttopt", TITLES["ttopt"], about, tuple(tables), pictures), work.out)
    write_text(work.out / "rows.jsonl", "".join(json.dumps(row) + "\n" for curve in found for row in curve.scores))
    return tables


def _modes(work: Work, row: Row, is_scratch: bool) -> tuple[str, ...]:
    if is_scratch:
        return (NO_PRIOR,)
    return (LATENTS, FIELD) if open_model(work, row).is_coded else (FIELD_ALONE,)


def _curve(work: Work, fit_work: Work, cars: Sequence[FittableCar], row: Row, mode: str, config: CurveConfig) -> Curve:
    """A curve from its file, or measured now."""
    folder, store = fit_work.out / "curves" / f"{row.name}-{mode.replace(' ', '-')}", fit_work.store
    path = folder / "curve.json"
    sha256 = describe_model(work.folder(row)).sha256
    settings = {"curve": asdict(config), "cars": [car.instance_id for car in cars]}
    asked = parse_json(json.dumps({**settings, "model": sha256, "data_sha256": store.data_sha256}), name=row.name)
    if path.exists():
        value = dict(read_json(path))
        if value["settings"] != asked:
            raise InputError(f"{folder}: fitted with other settings; give the same ones, or another --out")
        return Curve(row, mode, list(value["rows"]), folder, value["cpu_seconds"])
    began, model = time.process_time(), open_model(work, row)
    cache = PatchCache(store, model.encoder_side_px)
    shown = {car.instance_id: car for car in shown_cars(cars, store)}
    views = {shown_view(car, cache, config.held_out_views): car for car in shown.values()}

    def draw_strip(car: FittableCar, model: CategoryModel, latents: Latents) -> None:
        if car.instance_id in shown:
            write_strip(folder, car, cache, model, latents)

    lpips, report = load_lpips()[0], fit_work.report
    points = learning_curve(model, store, cars, config, lpips=lpips, on_fitted=draw_strip, report=report)
    for point in points:
        car = views.get(point.scored.pair.scored_patch_id)
        if car is not None:
            write_view(folder, car, point.steps, point.scored.rgb.numpy())
    steps = int(describe_model(work.folder(row)).provenance.get("step", 0))
    about: dict[str, Any] = {"method": f"{row.name}: {mode}", "steps": steps, "data_sha256": store.data_sha256}
    scores = [point.row(config, **about, sha256=sha256) for point in points]
    seconds = time.process_time() - began
    write_json(path, {"settings": asked, "rows": scores, "cpu_seconds": seconds})
    return Curve(row, mode, scores, folder, seconds)


def _some(cars: list[FittableCar], limit: int | None) -> list[FittableCar]:
    """At most so many cars, evenly spread."""
    if limit is None or len(cars) <= limit:
        return cars
    return [cars[i * len(cars) // limit] for i in range(limit)]


def shown_cars(cars: Sequence[FittableCar], store: PatchStore) -> list[FittableCar]:
    """Of the cars, those with the largest fitted photo."""
    pixels = {}
    table = store.table(["patch_id", "crop_width", "crop_height"])
    for patch, width, height in zip(*(table[name].to_pylist() for name in table.column_names), strict=True):
        pixels[patch] = width * height
    return sorted(cars, key=lambda car: (-max(pixels[p] for p in car.fitted), car.instance_id))[:SHOWN_CARS]


def shown_view(car: FittableCar, cache: PatchCache, most: int | None) -> str:
    """The scored view that pictures show: the middle one, which is neither the nearest nor the farthest around."""
    views = scored_views(car, cache, most)
    return views[len(views) // 2]
