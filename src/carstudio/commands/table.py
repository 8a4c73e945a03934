"""`carstudio table`: the paper's tables, every row trained and scored alike."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from carstudio.commands.command import Outcome, Output, plain, provenance
from carstudio.comparison.budgets import BUDGETS, Budget, BudgetName
from carstudio.comparison.learning_curves import fitted_rows, make_learning_curves, scratch_rows
from carstudio.comparison.rows import ROWS, SPLITS, chosen
from carstudio.comparison.running import Work
from carstudio.comparison.scaling import make_scaling, scaling_rows
from carstudio.comparison.table import make_table
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.evaluation.tables import Table, to_markdown
from carstudio.files import require_writable
from carstudio.locks import FolderLock
from carstudio.progress import Report
from carstudio.signals import held_back_stops

SMOKE_CARS, SMOKE_VIEWS, SMOKE_SIZE_PX = 12, 6, 48


@dataclass(frozen=True, kw_only=True)
class MakeTable(Output):
    """Train what is missing, score it by both protocols, and write NAME.md, NAME.tex, NAME.html and rows.jsonl.

    Started again with the same options it goes on, row by row.
    """

    name: tyro.conf.Positional[Literal["zero-shot", "multi-view", "scaling", "ttopt"]]
    """zero-shot (the paper's Table II), multi-view (its Table III), scaling (number of cars, recolouring, smaller
    images) or ttopt (its learning curve of test-time optimisation, beside NSG's object model)."""
    data: Path | None = None
    """The CarPatch3D store; without it (smoke only) a tiny synthetic one is made in OUT/cars."""
    fit_data: Path | None = None
    """ttopt: the store whose cars are fitted (the paper: KITTI-MOT, trained on KITTI-DET); --data when absent."""
    fit_split: str = "view"
    """ttopt: split of --fit-data by view, or one of `dataset split --by yaw`: its training part is fitted."""
    out: Path
    """Folder of the table and its runs."""
    budget: BudgetName = "cpu"
    """smoke: minutes for all rows, to see it work; cpu: the same processor seconds for every row, small fields; gpu:
    20,000 steps at paper size; paper: 500,000 steps x 3,072 rays."""
    cpu_seconds: float | None = None
    """Budget cpu: processor seconds of training per row (300)."""
    steps: int | None = None
    """Training steps per row, with budget cpu instead of processor seconds (for `scaling`: photos of many cars take
    longer to decode, so rows of equal time make unequal steps)."""
    rows: tuple[str, ...] = ()
    """Names of the rows; the paper's and car-gaussians when absent."""
    limit: int | None = None
    """Score at most so many photos per protocol (smoke 4, cpu 100, gpu 400, paper all)."""
    seed: int = 0
    """Start of all randomness."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""
    processes: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Processes that share each training step (on a CPU); their processor seconds are added up."""

    def saved(self) -> str:
        """Whole rows, and the checkpoint of the one in work."""
        return f"finished rows and the last checkpoint are kept in {self.out}/runs"

    def run(self) -> Outcome:
        """Make the table and print it."""
        budget = BUDGETS[self.budget]
        if self.cpu_seconds is not None:
            if budget.cpu_seconds is None:
                raise InputError(f"--cpu-seconds goes with --budget cpu, found --budget {self.budget}; give --steps")
            budget = replace(budget, cpu_seconds=self.cpu_seconds)
        if self.steps is not None:
            if self.cpu_seconds is not None:
                raise InputError("rows share either --steps or --cpu-seconds, found both")
            budget = replace(budget, steps=self.steps, cpu_seconds=None)
        budget = replace(budget, scored=self.limit if self.limit is not None else budget.scored)
        if self.fit_data is not None and self.name != "ttopt":
            raise InputError(f"--fit-data goes with `table ttopt`, found `table {self.name}`")
        require_writable(self.out / "rows.jsonl")
        with self.progress() as report, held_back_stops() as stops:
            work = Work(
                store=self._store(report),
                out=self.out,
                split=SPLITS[self.name],
                limit=budget.scored,
                seed=self.seed,
                device=self.device,
                processes=self.processes,
                command=provenance()["command"],
                report=report,
                should_stop=lambda: bool(stops),
            )
            with FolderLock(self.out):
                tables = self._make(work, budget)
        text = "\n".join(to_markdown(table) for table in tables)
        files = [str(self.out / f"{self.name}.{ending}") for ending in ("md", "tex", "html")]
        return Outcome(f"{text}\n{', '.join(files)}", {"files": files, "tables": plain(tables)})

    def _make(self, work: Work, budget: Budget) -> list[Table]:
        if self.name == "ttopt":
            store = work.store if self.fit_data is None else open_store(self.fit_data)
            fit_work = replace(work, store=store, split=self.fit_split)
            return make_learning_curves(work, fit_work, chosen([*fitted_rows(), *scratch_rows()], self.rows), budget)
        if self.name == "scaling":
            return make_scaling(work, chosen(scaling_rows(work.store, work.split), self.rows), budget)
        return make_table(self.name, work, chosen(ROWS[self.name](), self.rows), budget)

    def _store(self, report: Report) -> PatchStore:
        if self.data is not None:
            return open_store(self.data)
        if self.budget != "smoke":
            raise InputError(f"--data STORE is needed for --budget {self.budget}; only smoke makes its own cars")
        cars = self.out / "cars"
        synthesize(SynthConfig(out=cars, cars=SMOKE_CARS, views=SMOKE_VIEWS, size=SMOKE_SIZE_PX, workers=1), report)
        return open_store(cars)
