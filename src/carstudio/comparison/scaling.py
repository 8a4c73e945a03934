"""`scaling`: more training cars, recolouring, and integrated against plain encoding at smaller image sizes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from carstudio.comparison.budgets import Budget, within
from carstudio.comparison.document import Document, comparison_tables, write_document
from carstudio.comparison.recolouring import (
    Recolouring,
    RecolouringScore,
    draw_recolourings,
    read_recolourings,
    score_recolouring,
    write_recolourings,
)
from carstudio.comparison.rows import Row
from carstudio.comparison.running import Finished, Work, finish_row, open_model
from carstudio.comparison.table import TITLES, facts
from carstudio.dataset.store import PatchStore
from carstudio.evaluation.protocols import can_score, view_pairs
from carstudio.evaluation.results import ResultRow, read_rows, write_rows
from carstudio.evaluation.scales import DIVISORS, score_scales, size_name
from carstudio.evaluation.summary import estimate
from carstudio.evaluation.tables import Cell, Mark, Table
from carstudio.images import decode_image
from carstudio.models.car_nerf import CarNeRFConfig
from carstudio.recipes import recipe, supervised
from carstudio.report.plots import Point, curves
from carstudio.training.batches import training_patches

CARS = (100, 300, 1_000, 3_000)
PLAIN_OCTAVES = 10  # NeRF's; the integrated encoding's 16 would be noise without its damping
PAIRS, SMOKE_PAIRS = 24, 2
RECOLOUR_SIZE_PX = 96


def scaling_rows(store: PatchStore, split: str) -> list[Row]:
    """Car-NeRF and Car-Gaussians on 100, 300, 1,000, 3,000 cars as far as the store has them (all, where fewer), and
    Car-NeRF with plain encoding on the most.
    """
    available = len(set(training_patches(store, split=split).values()))
    counts = counts_for(available)
    rows = [
        _row(name, title, count, name)
        for name, title in (("car-nerf", "Car-NeRF"), ("car-gaussians", "Car-Gaussians"))
        for count in counts
    ]
    points = _row("car-nerf-points", "Car-NeRF, plain encoding", counts[-1], "car-nerf")
    model = points.config.model
    assert isinstance(model, CarNeRFConfig)
    model = replace(model, position_encoding="points", position_frequencies=PLAIN_OCTAVES)
    config = replace(points.config, model=model)
    return [*rows, replace(points, config=config)]


def counts_for(available: int) -> list[int]:
    """How many cars to train on: 100, 300, 1,000, 3,000, and all where that is plainly more than the last of them."""
    counts = [count for count in CARS if count <= available] or [max(1, available // 3)]
    return [*counts, available] if counts[-1] < CARS[-1] and available > 1.2 * counts[-1] else counts


def _row(name: str, title: str, cars: int, recipe_name: str) -> Row:
    full = f"{name}-{cars}"
    config = replace(supervised(recipe(recipe_name), "single-view"), recipe=full, most_cars=cars)
    return Row(full, f"{title}, {cars:,} cars", config)


def make_scaling(work: Work, rows: Sequence[Row], budget: Budget) -> list[Table]:
    """Finish every row and write the documents; returns the tables."""
    finished, pairs = [], _Pairs(SMOKE_PAIRS if budget.name == "smoke" else PAIRS, work)
    recolourings: dict[str, list[RecolouringScore]] = {}
    scales: list[ResultRow] = []
    for done, row in enumerate(rows):
        work.report("scaling", done, len(rows), row.name)
        finished.append(finish_row(work, replace(row, config=within(budget, row.config))))
        recolourings[row.name] = _recolour(work, row, pairs)
        if row.name in _compared_encodings(rows):
            scales += _scales(work, row, finished[-1])
    work.report("scaling", len(rows), len(rows), "")
    tables = [
        *comparison_tables(finished, title="Number of training cars"),
        recolouring_table(finished, recolourings),
        *([scales_table(finished, scales)] if scales else []),
    ]
    rest = [score for found in recolourings.values() for score in found]
    write_recolourings(work.out / "recolouring.jsonl", rest)
    scores = [score for done in finished for score in done.scores]
    write_rows(work.out / "rows.jsonl", [*scores, *scales], replace(finished[0].header, command=work.command))
    caption = "PSNR (dB) of unseen cars against the number of training cars; bars are 95 % intervals."
    plot = decode_image(curves(_points(finished), title="PSNR (dB)", x="training cars"), name="plot")
    pictures = (("scaling.png", caption, plot),)
    about = facts(work, finished, budget)
    write_document(Document("scaling", TITLES["scaling"], about, tuple(tables), pictures), work.out)
    return tables


@dataclass
class _Pairs:
    """The pairs to recolour, drawn when the first row asks for them."""

    count: int
    work: Work

    def __post_init__(self) -> None:
        self._drawn: dict[int, list[Recolouring]] = {}

    def at(self, side_px: int) -> list[Recolouring]:
        if side_px not in self._drawn:
            self._drawn[side_px] = draw_recolourings(
                self.count, size_px=RECOLOUR_SIZE_PX, side_px=side_px, report=self.work.report
            )
        return self._drawn[side_px]


def _recolour(work: Work, row: Row, pairs: _Pairs) -> list[RecolouringScore]:
    path = work.folder(row) / "recolouring.jsonl"
    if not path.exists():
        model = open_model(work, row)
        drawn = pairs.at(model.encoder_side_px)
        write_recolourings(path, [score_recolouring(model, pair, method=row.name) for pair in drawn])
    return read_recolourings(path)


def _compared_encodings(rows: Sequence[Row]) -> tuple[str, ...]:
    """Plain encoding, and integrated encoding on the same cars, where both are among the rows."""
    plain = [row.name for row in rows if row.name.startswith("car-nerf-points-")]
    integrated = [name.replace("-points", "") for name in plain]
    return (*integrated, *plain) if {row.name for row in rows} >= set(integrated) else ()


def _scales(work: Work, row: Row, done: Finished) -> list[ResultRow]:
    path = work.folder(row) / "smaller-images.jsonl"
    if not path.exists():
        config = work.evaluation("novel-view", row)
        if not can_score(work.store, config):
            config = work.evaluation("input-view", row)
        model, pairs = open_model(work, row), view_pairs(work.store, config)
        write_rows(path, score_scales(model, work.store, pairs, config, done.scores[0], report=work.report))
    return read_rows(path)


def recolouring_table(finished: Sequence[Finished], scores: dict[str, list[RecolouringScore]]) -> Table:
    """Means over pairs with intervals, one row per model."""
    columns = [
        _column([[(s.instance_id, getattr(s, name)) for s in scores[done.row.name]] for done in finished], digits, rank)
        for name, digits, rank in (("psnr", 2, True), ("ssim", 4, True), ("psnr_unchanged", 2, False),
                                   ("follow", 3, False), ("mask_iou", 4, True))
    ]  # fmt: skip
    rows = tuple((Cell(done.row.title), *(column[i] for column in columns)) for i, done in enumerate(finished))
    pairs = len(next(iter(scores.values())))
    return Table(
        caption=f"Recolouring {pairs} unseen synthetic cars with another car's texture code",
        columns=("Method", "PSNR (car) ↑", "SSIM (car) ↑", "PSNR left as it was", "Follow (1 is best)", "Mask IoU ↑"),
        rows=rows,
        notes=(
            "Truth: the same car built with the other's paint, photographed from the same place in the same light.",
            "Follow: share of the true change of mean colour that is made. Left as it was: the photo before.",
            "In brackets the 95 % interval of the mean, by resampling cars.",
        ),
    )


def scales_table(finished: Sequence[Finished], scales: Sequence[ResultRow]) -> Table:
    """PSNR at each image size, rows by encoding."""
    names = [done.row for done in finished if done.row.name in {score.method for score in scales}]
    columns, heads = [], []
    for metric, digits, head in (("psnr", 2, "PSNR"), ("ssim", 4, "SSIM")):
        for divisor in DIVISORS:
            of_size = [score for score in scales if score.split.endswith(f" at {size_name(divisor)}")]
            values = [[(s.instance_id, getattr(s, metric)) for s in of_size if s.method == row.name] for row in names]
            columns.append(_column(values, digits, True))
            heads.append(f"{head} {size_name(divisor)}")
    rows = tuple((Cell(row.title), *(column[i] for column in columns)) for i, row in enumerate(names))
    return Table(
        caption=f"Integrated against plain positional encoding at smaller images, protocol {scales[0].protocol}",
        columns=("Method", *heads),
        rows=rows,
        notes=(
            "Trained at full size. The truth is the mean of the full-size photo over each larger pixel; the model "
            "draws the small image directly. In brackets the 95 % interval of the mean, by resampling cars.",
        ),
    )


def _column(groups: Sequence[Sequence[tuple[str, float | None]]], digits: int, is_ranked: bool) -> list[Cell]:
    found = [[(who, value) for who, value in group if value is not None] for group in groups]
    means = [estimate([v for _, v in group], [w for w, _ in group]) if group else None for group in found]
    texts = ["–" if mean is None else f"{mean.mean:.{digits}f}" for mean in means]
    ranked = sorted({float(text) for text in texts if text != "–"}, reverse=True)
    cells = []
    for mean, text in zip(means, texts, strict=True):
        detail = ""
        if mean is not None and mean.low is not None and mean.high is not None:
            detail = f"[{mean.low:.{digits}f}, {mean.high:.{digits}f}]"
        mark: Mark = ""
        if is_ranked and len(groups) > 1 and text != "–" and float(text) in ranked[:2]:
            mark = "best" if float(text) == ranked[0] else "second"
        cells.append(Cell(text, mark, detail))
    return cells


def _points(finished: Sequence[Finished]) -> dict[str, list[Point]]:
    series: dict[str, list[Point]] = {}
    for done in finished:
        for protocol in dict.fromkeys(score.protocol for score in done.scores):
            scored = [(s.instance_id, s.psnr) for s in done.scores if s.protocol == protocol and s.psnr is not None]
            found = estimate([value for _, value in scored], [who for who, _ in scored])
            title = done.row.title.rpartition(", ")[0]
            x = float(done.row.config.most_cars or 0)
            low, high = (found.mean if end is None else end for end in (found.low, found.high))
            series.setdefault(f"{title}, {protocol}", []).append(Point(x, found.mean, low, high))
    return series
