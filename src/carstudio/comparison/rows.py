"""The rows of the paper's tables: which recipe, trained and called how."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from carstudio.comparison.paper_figures import MULTI_VIEW, ZERO_SHOT, PaperFigures
from carstudio.errors import InputError
from carstudio.recipes import recipe, supervised
from carstudio.training.batches import Supervision
from carstudio.training.config import TrainConfig

SPLITS = {"zero-shot": "instance", "multi-view": "view", "scaling": "instance", "ttopt": "instance"}


@dataclass(frozen=True)
class Row:
    """One row: a name for files and `--rows`, the title in the table, how it is trained, the paper's own figures."""

    name: str
    title: str
    config: TrainConfig
    paper: PaperFigures | None = None
    is_default: bool = True


def zero_shot_rows() -> list[Row]:
    """Table II: each photo explains itself (single-view supervision); the cars that are scored were never seen.

    PixelNeRF with the global latent and the code per car, whose unseen cars are all the mean car, come by name only.
    """
    titles = {
        "pixelnerf-resnet": "PixelNeRF-ResNet",
        "pixelnerf-resnet-global": "PixelNeRF-ResNet (global latent, as released)",
        "pixelnerf-mlp": "PixelNeRF-MLP",
        "autorf": "AutoRF",
        "autorf-occupancy": "AutoRF (occupancy loss)",
        "code-nerf": "CodeNeRF (mean code)",
        "car-nerf-no-mask": "Car-NeRF (w/o mask)",
        "car-nerf": "Car-NeRF (w/ mask)",
        "car-gaussians": "Car-Gaussians (not in the paper)",
    }
    by_name = {"pixelnerf-resnet-global", "autorf-occupancy", "code-nerf"}
    return [_row(name, title, name, "single-view", ZERO_SHOT, name not in by_name) for name, title in titles.items()]


def multi_view_rows() -> list[Row]:
    """Table III: another photo of the car must be explained, but for the last rows; other photos of the same cars.

    CodeNeRF's code of a car is the same for all its photos, so that both kinds of supervision are one.
    """
    rows = [
        _row("pixelnerf-mlp", "PixelNeRF-MLP", "pixelnerf-mlp", "multi-view", MULTI_VIEW),
        _row("autorf", "AutoRF", "autorf", "multi-view", MULTI_VIEW),
        _row("code-nerf", "CodeNeRF", "code-nerf", "multi-view", MULTI_VIEW),
        _row("car-nerf-multi-view", "Car-NeRF (multi-view)", "car-nerf", "multi-view", MULTI_VIEW),
        _row("car-nerf-single-view", "Car-NeRF (single-view)", "car-nerf", "single-view", MULTI_VIEW),
        _row("car-gaussians-multi-view", "Car-Gaussians (multi-view)", "car-gaussians", "multi-view", MULTI_VIEW),
        _row("car-gaussians-single-view", "Car-Gaussians (single-view)", "car-gaussians", "single-view", MULTI_VIEW),
    ]
    return [replace(row, config=replace(row.config, least_views=2)) for row in rows]


def _row(
    name: str,
    title: str,
    recipe_name: str,
    supervision: Supervision,
    paper: dict[str, PaperFigures],
    is_default: bool = True,
) -> Row:
    config = replace(supervised(recipe(recipe_name), supervision), recipe=name)
    return Row(name, title, config, paper.get(name), is_default)


ROWS: dict[str, Callable[[], list[Row]]] = {"zero-shot": zero_shot_rows, "multi-view": multi_view_rows}


def chosen(rows: list[Row], names: tuple[str, ...]) -> list[Row]:
    """The rows of these names in the table's order; the default ones when no name is given."""
    unknown = sorted(set(names) - {row.name for row in rows})
    if unknown:
        raise InputError(f"--rows: no row {unknown}; there are {', '.join(row.name for row in rows)}")
    return [row for row in rows if (row.name in names if names else row.is_default)]
