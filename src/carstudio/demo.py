"""The demo: photographs -> CarPatch3D -> a category model -> cars never seen, turned around -> one HTML report.

Each step leaves its result in the demo's folder and is skipped when that is there, so that a killed demo goes on.
"""

import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from carstudio import __version__
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import PatchStore, open_store
from carstudio.devices import pick_device
from carstudio.files import read_json, write_json
from carstudio.progress import Report, silent
from carstudio.recipes import recipe
from carstudio.report.panels import views_panel
from carstudio.report.run_page import RunPageConfig, write_run_page
from carstudio.signals import held_back_stops
from carstudio.training.team import good_number_of_processes
from carstudio.training.trainer import TrainSummary, train

SCORED_IMAGES = 120
TURNTABLES = 6


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Size of the demo; the defaults take six and a half minutes on three cores."""

    out: Path
    cars: int = 200
    views: int = 12
    minutes: float = 5.0
    model: str = "car-gaussians"
    seed: int = 0
    device: str = "auto"

    @property
    def data(self) -> Path:
        """The synthetic store."""
        return self.out / "cars"

    @property
    def run(self) -> Path:
        """The trained model."""
        return self.out / self.model

    def commands(self) -> list[str]:
        """The same path step by step on the command line."""
        data, run = shlex.quote(str(self.data)), shlex.quote(str(self.run))
        lines = [
            f"carstudio synth --cars {self.cars} --views {self.views} --size 128 --seed {self.seed} --out {data}",
            f"carstudio train {self.model} --data {data} --out {run} --minutes {self.minutes:g} --seed {self.seed} "
            f"--processes {good_number_of_processes(pick_device(self.device))}",
        ]
        out = shlex.quote(str(self.out))
        return [*lines, f"carstudio report {run} --data {data} --out {out} --limit {SCORED_IMAGES}"]


def run_demo(config: DemoConfig, report: Report = silent) -> dict[str, Any]:
    """Do what is not done yet and write `index.html`; returns the novel-view figures of the unseen cars."""
    store = _photograph(config, report)
    with held_back_stops() as stops:
        summary = _train(config, store, report, lambda: bool(stops))
    summaries = write_run_page(
        config.run,
        store,
        config.out,
        RunPageConfig(limit=SCORED_IMAGES, turntables=TURNTABLES, device=config.device),
        title="Car-Studio demo",
        lead=(
            f"{config.cars} synthetic cars were photographed from {config.views} sides each; {config.model} was "
            f"trained for {summary['seconds'] / 60:.1f} minutes on nine tenths of them ({summary['rays_per_s']:,.0f} "
            "rays/s) and then shown one photo each of the others, which it had never seen."
        ),
        commands=config.commands(),
        report=report,
    )
    figures = {name: found.mean for name, found in summaries[0].metrics.items()}
    return {**figures, "rays_per_s": summary["rays_per_s"], "steps": summary["steps"]}


def _photograph(config: DemoConfig, report: Report) -> PatchStore:
    done = config.out / "cars.json"
    wanted = {"cars": config.cars, "views": config.views, "seed": config.seed, "version": __version__}
    if not done.exists() or read_json(done) != wanted:
        synthesize(SynthConfig(out=config.data, cars=config.cars, views=config.views, seed=config.seed), report)
        write_json(done, wanted)
    return open_store(config.data)


def _train(config: DemoConfig, store: PatchStore, report: Report, should_stop: Callable[[], bool]) -> dict[str, Any]:
    done = config.run / "summary.json"
    if done.exists():
        return dict(read_json(done))
    summary: TrainSummary = train(
        replace(recipe(config.model), minutes=config.minutes, seed=config.seed),
        store,
        config.run,
        device=config.device,
        resume=(config.run / "training.safetensors").exists(),
        provenance={"command": config.commands()[1], "data_sha256": store.data_sha256, "carstudio": __version__},
        report=report,
        on_save=lambda model, step: views_panel(
            model, store, config.run / "pictures" / f"step-{step:07d}.png", "instance", 4
        ),
        should_stop=should_stop,
        processes=good_number_of_processes(pick_device(config.device)),
    )
    write_json(done, asdict(summary))
    return asdict(summary)
