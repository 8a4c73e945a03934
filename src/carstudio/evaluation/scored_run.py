"""A trained model scored on a store: pairs, scores and result rows in one call."""

from dataclasses import dataclass
from pathlib import Path

from carstudio.dataset.store import PatchStore
from carstudio.evaluation.perceptual import load_lpips
from carstudio.evaluation.protocols import EvaluationConfig, ScoredView, result_row, score_views, view_pairs
from carstudio.evaluation.results import ResultHeader, ResultRow, write_rows
from carstudio.models.interface import CategoryModel
from carstudio.progress import Report, silent
from carstudio.training.checkpoint import ModelDescription

SHOWN = 12  # scored views whose pixels are kept for pictures


@dataclass(frozen=True)
class ScoredRun:
    """One row per scored image, and some of the views themselves: of different cars first, evenly spread."""

    rows: list[ResultRow]
    shown: list[ScoredView]
    header: ResultHeader

    def write(self, path: Path) -> None:
        """Rows as JSON lines, the header beside them."""
        write_rows(path, self.rows, self.header)


def score_run(
    model: CategoryModel,
    description: ModelDescription,
    store: PatchStore,
    config: EvaluationConfig,
    *,
    command: str = "",
    report: Report = silent,
) -> ScoredRun:
    """Score a model by one protocol; the rows name recipe, step and checksums."""
    lpips, reason = load_lpips()
    rows, views = [], []
    pairs = view_pairs(store, config)
    keep = _spread(len(pairs), {pair.instance_id: i for i, pair in reversed(list(enumerate(pairs)))})
    for i, view in enumerate(
        score_views(model, store, pairs, lpips=lpips, report=report, description=f"score {config.protocol}")
    ):
        rows.append(
            result_row(
                view,
                config,
                method=str(description.provenance.get("recipe", "unnamed")),
                steps=int(description.provenance.get("step", 0)),
                data_sha256=store.data_sha256,
                checkpoint_sha256=description.sha256,
            )
        )
        if i in keep:
            views.append(view)
    header = ResultHeader(command=command, reasons={} if lpips is not None else {"lpips": str(reason)})
    return ScoredRun(rows, views, header)


def _spread(count: int, first_of_car: dict[str, int]) -> set[int]:
    """Places of at most `SHOWN` views: each car's first one, filled up evenly."""
    firsts = sorted(first_of_car.values())
    chosen = {firsts[i * len(firsts) // SHOWN] for i in range(SHOWN)} if len(firsts) > SHOWN else set(firsts)
    rest = [i for i in range(count) if i not in chosen]
    missing = min(SHOWN - len(chosen), len(rest))
    return chosen | {rest[i * len(rest) // missing] for i in range(missing)}
