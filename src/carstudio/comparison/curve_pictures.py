"""Pictures of `ttopt`: the curves, views before and after fitting, cars turned where they stand beside the truth."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from carstudio.comparison.curves import FIELD, LATENTS, Curve, estimate_of
from carstudio.dataset.pixels import PatchCache, PreparedPatch
from carstudio.evaluation.learning_curve import FittableCar
from carstudio.geometry.camera import Camera
from carstudio.images import decode_image, read_image, to_uint8, write_png
from carstudio.models.interface import CategoryModel, Latents
from carstudio.report.panels import truth_on_black
from carstudio.report.plots import Point, curves
from carstudio.report.rotation_strip import rotation_strip, seen_by, strip_camera, true_views
from carstudio.report.sheets import Pixels, fit, named_rows, side_by_side
from carstudio.training.batches import stack_boxes

TILE_PX, STRIP_TILE_PX, SIDE_BY_SIDE = (128, 80), (80, 40), 2
STATES = ("before", "+ latents", "+ field, or no prior")


def file_name(car: FittableCar) -> str:
    """A car's id as part of a file's name."""
    return "".join(letter if letter.isalnum() or letter in "-_" else "_" for letter in car.instance_id)


def turned_photo(car: FittableCar, cache: PatchCache) -> PreparedPatch:
    """The fitted photo whose car is turned: of which the most turned views were photographed, else the first."""
    others = [cache[patch] for patch in car.held_out]
    return max((cache[patch] for patch in car.fitted), key=lambda photo: _num_true(others, photo))


def _num_true(others: Sequence[PreparedPatch], photo: PreparedPatch) -> int:
    return sum(view is not None for view in true_views(others, photo.box))


def write_strip(folder: Path, car: FittableCar, cache: PatchCache, model: CategoryModel, latents: Latents) -> None:
    """`strip-CAR.png`: a fitted car turned all around, drawn at the size of its tiles."""
    photo = turned_photo(car, cache)
    pictures = rotation_strip(model, latents, stack_boxes([photo.box]), _camera_of(photo))
    write_png(folder / f"strip-{file_name(car)}.png", np.concatenate(pictures, 1))


def _camera_of(photo: PreparedPatch) -> Camera:
    return strip_camera(photo.box, photo.camera, *STRIP_TILE_PX)


def pictures_of(
    found: Sequence[Curve], cars: Sequence[FittableCar], views: dict[str, str], cache: PatchCache
) -> tuple[tuple[str, str, Pixels], ...]:
    """File name, caption and picture of each; `views` is the held-out view of each car that is shown."""
    families = [curve.row.name for curve in found]
    lines = {curve.title: _points(curve) for curve in found}
    drawn = curves(lines, title="PSNR (dB) of held-out views", x="steps of fitting (+ 1)", families=families)
    before_after, strips = _before_after(found, cars, views, cache), named_rows(_strips(found, cars, cache))
    turned = "Turned by 360 / 19 degrees a step after fitting, beside the photo that begins the turn."
    return (
        ("curve.png", "Held-out views while latents, or latents and field, are fitted.", decode_image(drawn, name="")),
        ("before_after.png", "A held-out view per car before and after fitting.", before_after),
        ("strips.png", turned, strips),
    )


def _before_after(
    found: Sequence[Curve], cars: Sequence[FittableCar], views: dict[str, str], cache: PatchCache
) -> Pixels:
    """A line per model, a block of columns per car."""
    shown, names = cars[:SIDE_BY_SIDE], list(dict.fromkeys(curve.row.name for curve in found))
    blank = np.full((TILE_PX[1], TILE_PX[0], 3), 255, np.uint8)
    rows = []
    for name in names:
        row: list[Pixels] = []
        for car in shown:
            states = dict.fromkeys(STATES, blank)
            for curve in found:
                if curve.row.name == name:
                    states |= _states(curve, car)
            truth = truth_on_black(cache[views[car.instance_id]])
            row += [turned_photo(car, cache).rgb.numpy(), truth, *states.values()]
        rows.append(row)
    heads = ["fitted photo", "truth", *STATES] * len(shown)
    return side_by_side(rows, heads=heads, captions=names, tile_px=TILE_PX)


def _states(curve: Curve, car: FittableCar) -> dict[str, Pixels]:
    """What a curve shows of a car, by the heads of `_before_after`."""
    first, last = (read_image(curve.pictures / f"{file_name(car)}-{m}.png") for m in (curve.marks[0], curve.marks[-1]))
    after = STATES[1] if curve.mode == LATENTS else STATES[2]
    is_fitted = len(curve.marks) > 1 and curve.mode != FIELD
    return {STATES[0]: first, after: last} if is_fitted else {after: last}


def _strips(found: Sequence[Curve], cars: Sequence[FittableCar], cache: PatchCache) -> list[tuple[str, Pixels]]:
    rows: list[tuple[str, Pixels]] = []
    for car in cars:
        photo = turned_photo(car, cache)
        tile = fit(photo.rgb.numpy(), *STRIP_TILE_PX)
        for curve in found:
            strip = read_image(curve.pictures / f"strip-{file_name(car)}.png")
            rows.append((curve.title, np.concatenate([tile, strip], 1)))
        true = true_views([photo, *(cache[patch] for patch in car.held_out)], photo.box)
        if sum(view is not None for view in true) > 1:
            nothing = np.full((STRIP_TILE_PX[1], STRIP_TILE_PX[0], 3), 255, np.uint8)
            seen = [nothing if view is None else seen_by(view, _camera_of(photo)) for view in true]
            rows.append(("truth", np.concatenate([tile, *seen], 1)))
        rows.append(("", tile))
    return rows[:-1]


def write_view(folder: Path, car: FittableCar, steps: int, rgb: np.ndarray) -> None:
    """`CAR-STEPS.png`: the shown view after some steps."""
    write_png(folder / f"{file_name(car)}-{steps}.png", to_uint8(rgb))


def _points(curve: Curve) -> list[Point]:
    scores = [score for score in curve.scores if score["views"] == "held-out"]
    points = []
    for mark in curve.marks:
        found = estimate_of(scores, mark, "psnr")
        low, high = (found.mean if end is None else end for end in (found.low, found.high))
        points.append(Point(mark + 1.0, found.mean, low, high))
    return points
