"""`ttopt`: the paper's learning curve. Models trained on one store are fitted to cars of another and scored on the way.

NSG's object model, which has no prior, is trained on the very photos that the others are fitted to.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from carstudio.comparison.budgets import Budget, BudgetName, within
from carstudio.comparison.document import Document, write_document
from carstudio.comparison.rows import Row
from carstudio.comparison.running import Work, open_model, train_row
from carstudio.comparison.table import TITLES, facts_of
from carstudio.dataset.pixels import PatchCache
from carstudio.errors import InputError
from carstudio.evaluation.learning_curve import MARKS, CurveConfig, FittableCar, fittable_cars, learning_curve
from carstudio.evaluation.perceptual import load_lpips
from carstudio.evaluation.summary import Estimate, estimate
from carstudio.evaluation.tables import Cell, Table
from carstudio.files import parse_json, read_json, write_json, write_text
from carstudio.images import decode_image, read_image, to_uint8, write_png
from carstudio.models.interface import CategoryModel, Latents
from carstudio.recipes import recipe
from carstudio.report.panels import truth_on_black
from carstudio.report.plots import Point, curves
from carstudio.report.rotation_strip import rotation_strip
from carstudio.report.sheets import Pixels, fit, side_by_side
from carstudio.training.batches import stack_boxes
from carstudio.training.checkpoint import describe_model

LATENTS, FIELD, FIELD_ALONE, NO_PRIOR = "latents", "latents and field", "field", "no prior"
FIELD_RATES = {"car-gaussians": 3e-3}  # numbers of Gaussians bear larger steps than weights of a network
USUAL_FIELD_RATE = 3e-4
MARKS_OF: dict[BudgetName, tuple[int, ...]] = {"smoke": (0, 2, 6), "cpu": MARKS}
MANY_MARKS = (*MARKS, 500, 1000)
TURNS_DEG = (0, 15, 45, 90, 181)
SHOWN_CARS, TILE_PX, STRIP_TILE_PX = 4, (128, 96), (80, 60)


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
    return Row(name, title, replace(recipe(name), recipe=name, supervision="single-view"))


@dataclass(frozen=True)
class Curve:
    """One row fitted in one way: its scores at every mark, and where its pictures are."""

    row: Row
    mode: str
    scores: list[dict[str, Any]]
    pictures: Path

    @property
    def title(self) -> str:
        """How tables call it."""
        return f"{self.row.title}: {self.mode}"


def make_learning_curves(work: Work, fit_work: Work, rows: Sequence[Row], budget: Budget) -> list[Table]:
    """Train, fit and score what is missing; write `ttopt.md`, `.tex`, `.html`, pictures and `rows.jsonl`.

    `work` has the store that models are trained on, `fit_work` the one whose cars are fitted.
    """
    marks = MARKS_OF.get(budget.name, MANY_MARKS)
    found, spent = [], []
    for done, row in enumerate(rows):
        work.report("ttopt", done, len(rows), row.name)
        is_scratch = row.name in {one.name for one in scratch_rows()}
        where = fit_work if is_scratch else work
        trained, summary = train_row(where, replace(row, config=within(budget, row.config)))
        spent.append((row, summary))
        for mode in _modes(where, row, is_scratch):
            config = CurveConfig(
                marks=(0,) if is_scratch else marks,
                field_rate=FIELD_RATES.get(row.name, USUAL_FIELD_RATE) if mode in (FIELD, FIELD_ALONE) else 0.0,
                split=fit_work.split,
                seed=work.seed,
            )
            found.append(_curve(where, fit_work, trained, mode, config))
    work.report("ttopt", len(rows), len(rows), "")
    tables = [curve_table(found, "held-out", max(marks)), curve_table(found, "fitted", max(marks))]
    if fit_work.split != "view":
        tables.append(turn_table(found))
    name, title = "ttopt", TITLES["ttopt"]
    fitted = fit_work.store
    which = ("fitted cars", f"{fitted.path.name}, sha256 {fitted.data_sha256[:16]}, split {fit_work.split}")
    about = (*facts_of(work, spent, budget), which)
    write_document(Document(name, title, about, tuple(tables), _pictures(found, fit_work, marks)), work.out)
    write_text(work.out / "rows.jsonl", "".join(json.dumps(row) + "\n" for curve in found for row in curve.scores))
    return tables


def _modes(work: Work, row: Row, is_scratch: bool) -> tuple[str, ...]:
    if is_scratch:
        return (NO_PRIOR,)
    return (LATENTS, FIELD) if open_model(work, row).is_coded else (FIELD_ALONE,)


def _curve(work: Work, fit_work: Work, row: Row, mode: str, config: CurveConfig) -> Curve:
    """A curve from its file, or measured now."""
    folder = fit_work.out / "curves" / f"{row.name}-{mode.replace(' ', '-')}"
    path = folder / "curve.json"
    sha256 = describe_model(work.folder(row)).sha256
    asked = parse_json(
        json.dumps({"curve": asdict(config), "model": sha256, "data_sha256": fit_work.store.data_sha256}), name=row.name
    )
    if path.exists():
        value = dict(read_json(path))
        if value["settings"] != asked:
            raise InputError(f"{folder}: fitted with other settings; give the same ones, or another --out")
        return Curve(row, mode, list(value["rows"]), folder)
    model, lpips = open_model(work, row), load_lpips()[0]
    cars = _some(fittable_cars(fit_work.store, config.split), fit_work.limit)
    shown = {car.instance_id for car in shown_cars(cars, fit_work)}
    cache = PatchCache(fit_work.store, model.encoder_side_px)

    def draw_strip(car: FittableCar, model: CategoryModel, latents: Latents) -> None:
        if car.instance_id in shown:
            patch = cache[car.fitted[0]]
            strip = rotation_strip(model, latents, stack_boxes([patch.box]), patch.camera)
            write_png(folder / f"strip-{_file(car)}.png", np.concatenate([fit(p, *STRIP_TILE_PX) for p in strip], 1))

    report = fit_work.report
    points = learning_curve(model, fit_work.store, cars, config, lpips=lpips, on_fitted=draw_strip, report=report)
    for point in points:
        car = next(car for car in cars if point.scored.pair.scored_patch_id in car.held_out + car.fitted)
        if car.instance_id in shown and point.scored.pair.scored_patch_id == car.held_out[0]:
            write_png(folder / f"{_file(car)}-{point.steps}.png", to_uint8(point.scored.rgb.numpy()))
    steps = int(describe_model(work.folder(row)).provenance.get("step", 0))
    method = f"{row.name}: {mode}"
    data_sha256 = fit_work.store.data_sha256
    scores = [p.row(config, method=method, steps=steps, data_sha256=data_sha256, sha256=sha256) for p in points]
    write_json(path, {"settings": asked, "rows": scores})
    return Curve(row, mode, scores, folder)


def _some(cars: list[FittableCar], limit: int | None) -> list[FittableCar]:
    """At most so many cars, evenly spread."""
    if limit is None or len(cars) <= limit:
        return cars
    return [cars[i * len(cars) // limit] for i in range(limit)]


def shown_cars(cars: Sequence[FittableCar], work: Work) -> list[FittableCar]:
    """Of the cars, those with the largest fitted photo."""
    pixels = {}
    table = work.store.table(["patch_id", "crop_width", "crop_height"])
    for patch, width, height in zip(*(table[name].to_pylist() for name in table.column_names), strict=True):
        pixels[patch] = width * height
    return sorted(cars, key=lambda car: (-pixels[car.fitted[0]], car.instance_id))[:SHOWN_CARS]


def _file(car: FittableCar) -> str:
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in car.instance_id)


def curve_table(found: Sequence[Curve], views: str, last: int) -> Table:
    """Before and after: what the encoder gives, what is there after the last step, and where it was best."""
    rows = []
    for curve in found:
        scores = [score for score in curve.scores if score["views"] == views]
        marks = sorted({score["fit_steps"] for score in scores})
        values = {mark: _estimate(scores, mark, "psnr") for mark in marks}
        best = max(marks, key=lambda mark: values[mark].mean)
        rows.append(
            (
                Cell(curve.title),
                Cell(str(values[marks[0]].count)),
                Cell(str(len({score["instance_id"] for score in scores}))),
                _cell(values[marks[0]], 2),
                _cell(values[marks[-1]], 2),
                Cell(f"{values[best].mean:.2f} at {best}"),
                _cell(_estimate(scores, marks[0], "ssim"), 4),
                _cell(_estimate(scores, marks[-1], "ssim"), 4),
                _cell(_estimate(scores, marks[0], "psnr_mask"), 2),
                _cell(_estimate(scores, marks[-1], "psnr_mask"), 2),
            )
        )
    heads = ("PSNR before", f"PSNR after {last}", "best at step", "SSIM before", "SSIM after")
    what = "views that no step saw" if views == "held-out" else "the very views that were fitted"
    return Table(
        caption=f"{TITLES['ttopt']}: {what}",
        columns=("Method", "Images", "Cars", *heads, "PSNR (car) before", "PSNR (car) after"),
        rows=tuple(rows),
        notes=(
            "In brackets the 95 % interval of the mean, by resampling cars.",
            "PSNR in dB on the box crop, truth on black.",
        ),
    )


def turn_table(found: Sequence[Curve]) -> Table:
    """PSNR after the last step by how far around the car a held-out view was taken from the nearest fitted one."""
    ranges = list(pairwise(TURNS_DEG))
    rows = []
    for curve in found:
        last = max(score["fit_steps"] for score in curve.scores)
        cells = []
        for low, high in ranges:
            chosen = [s for s in curve.scores if s["views"] == "held-out" and low <= s["turned_deg"] < high]
            cells.append(_cell(_estimate(chosen, last, "psnr"), 2) if chosen else Cell("–"))
        rows.append((Cell(curve.title), *cells))
    heads = [f"{low} to {min(high, 180)} deg" for low, high in ranges]
    caption = "PSNR (dB) after fitting, by the angle to the nearest fitted view"
    return Table(caption=caption, columns=("Method", *heads), rows=tuple(rows))


def _estimate(scores: Sequence[dict[str, Any]], mark: int, metric: str) -> Estimate:
    chosen = [(s[metric], s["instance_id"]) for s in scores if s["fit_steps"] == mark and s[metric] is not None]
    if not chosen:
        return Estimate(float("nan"), None, None, 0)
    return estimate([value for value, _ in chosen], [who for _, who in chosen])


def _cell(found: Estimate, digits: int) -> Cell:
    if found.count == 0:
        return Cell("–")
    detail = "" if found.low is None or found.high is None else f"[{found.low:.{digits}f}, {found.high:.{digits}f}]"
    return Cell(f"{found.mean:.{digits}f}", detail=detail)


def _pictures(found: Sequence[Curve], work: Work, marks: Sequence[int]) -> tuple[tuple[str, str, Pixels], ...]:
    """The curves, before beside after, and the cars turned where they stand."""
    cars = shown_cars(_some(fittable_cars(work.store, work.split), work.limit), work)
    cache = PatchCache(work.store, 8)
    lines = {curve.title: _points(curve) for curve in found}
    drawn = curves(lines, title="PSNR (dB) of held-out views", x="steps of fitting (+ 1)")
    plot = decode_image(drawn, name="curve.png")
    heads = ["fitted photo", *(f"{c.row.name} {t}" for c in found for t in _times(c)), "truth"]
    body, strips = [], []
    for car in cars:
        photo = cache[car.fitted[0]].rgb.numpy()
        tiles = [_read(c.pictures / f"{_file(car)}-{mark}.png") for c in found for mark in _marks(c)]
        body.append([photo, *tiles, truth_on_black(cache[car.held_out[0]])])
        strips += [[fit(photo, *STRIP_TILE_PX), _read(c.pictures / f"strip-{_file(car)}.png")] for c in found]
    names = [f"{curve.row.name}, {curve.mode}" for _ in cars for curve in found]
    strip = np.concatenate([np.concatenate(row, 1) for row in strips])
    turned = "; ".join(dict.fromkeys(names))
    return (
        ("curve.png", "Held-out views while latents, or latents and field, are fitted.", plot),
        ("before_after.png", "One held-out view per car: before and after fitting.",
         side_by_side(body, heads=heads, tile_px=TILE_PX)),
        ("strips.png", f"Turned by 360 / 19 degrees a step after fitting, beside the photo; rows: {turned}.", strip),
    )  # fmt: skip


def _marks(curve: Curve) -> list[int]:
    marks = sorted({score["fit_steps"] for score in curve.scores})
    return [marks[0], marks[-1]] if len(marks) > 1 and curve.mode != FIELD else marks[-1:]


def _times(curve: Curve) -> list[str]:
    after = {LATENTS: "+ latents", FIELD: "+ field", FIELD_ALONE: "+ field"}.get(curve.mode, "")
    return ["before", after] if len(_marks(curve)) > 1 else [after]


def _points(curve: Curve) -> list[Point]:
    scores = [score for score in curve.scores if score["views"] == "held-out"]
    points = []
    for mark in sorted({score["fit_steps"] for score in scores}):
        found = _estimate(scores, mark, "psnr")
        low, high = (found.mean if end is None else end for end in (found.low, found.high))
        points.append(Point(mark + 1.0, found.mean, low, high))
    return points


def _read(path: Path) -> Pixels:
    return read_image(path)
