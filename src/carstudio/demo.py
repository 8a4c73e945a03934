"""The demo: photographs -> CarPatch3D -> Car-NeRF -> cars never seen, turned around -> one HTML report.

Each step leaves its result in the demo's folder and is skipped when that is there, so that a killed demo goes on.
"""

import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from carstudio import __version__
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import PatchStore, open_store
from carstudio.evaluation.perceptual import load_lpips
from carstudio.evaluation.protocols import EvaluationConfig, Protocol, ScoredView, result_row, score_views, view_pairs
from carstudio.evaluation.results import ResultHeader, ResultRow, write_rows
from carstudio.evaluation.summary import summarise
from carstudio.evaluation.tables import result_tables, to_markdown
from carstudio.files import read_json, write_json, write_text
from carstudio.images import encode_png, write_png
from carstudio.models.interface import CategoryModel
from carstudio.progress import Report, silent
from carstudio.recipes import recipe
from carstudio.report.page import Commands, Gallery, KeyFigure, Page, Picture, Section, Text, write_page
from carstudio.report.panels import encode_patch, turntable, views_panel, views_sheet
from carstudio.report.plots import learning_curve
from carstudio.report.sheets import fit
from carstudio.report.video import write_gif
from carstudio.signals import held_back_stops
from carstudio.training.checkpoint import describe_model, load_model, pick_device
from carstudio.training.log import read_log
from carstudio.training.trainer import TrainSummary, train

PROTOCOLS: tuple[Protocol, ...] = ("novel-view", "input-view")
SCORED_IMAGES = 120
TURNTABLES = 6


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Size of the demo; the defaults take about nine minutes on four cores."""

    out: Path
    cars: int = 200
    views: int = 12
    minutes: float = 5.0
    seed: int = 0
    device: str = "auto"

    @property
    def data(self) -> Path:
        """The synthetic store."""
        return self.out / "cars"

    @property
    def run(self) -> Path:
        """The trained model."""
        return self.out / "car-nerf-small"

    def commands(self) -> list[str]:
        """The same path step by step on the command line."""
        data, run = shlex.quote(str(self.data)), shlex.quote(str(self.run))
        lines = [
            f"carstudio synth --cars {self.cars} --views {self.views} --size 128 --seed {self.seed} --out {data}",
            f"carstudio train car-nerf-small --data {data} --out {run} --minutes {self.minutes:g} --seed {self.seed}",
        ]
        lines += [
            f"carstudio evaluate {run} --data {data} --protocol {protocol} --limit {SCORED_IMAGES} "
            f"--out {shlex.quote(str(self.out / f'{protocol}.jsonl'))}"
            for protocol in PROTOCOLS
        ]
        return [*lines, f"carstudio render {run} --data {data} --out {shlex.quote(str(self.out / 'render'))}"]


def run_demo(config: DemoConfig, report: Report = silent) -> dict[str, Any]:
    """Do what is not done yet and write `index.html`; returns the novel-view figures of the unseen cars."""
    store = _photograph(config, report)
    with held_back_stops() as stops:
        summary = _train(config, store, report, lambda: bool(stops))
    model = load_model(config.run, device=pick_device(config.device))
    rows, views = _score(config, model, store, report)
    turned = _turn(config, model, store, report)
    figures = {name: found.mean for name, found in summarise(rows)[0].metrics.items()}
    _write_report(config, store, summary, rows, views, turned)
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
        replace(recipe("car-nerf-small"), minutes=config.minutes, seed=config.seed),
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
    )
    write_json(done, asdict(summary))
    return asdict(summary)


def _score(
    config: DemoConfig, model: CategoryModel, store: PatchStore, report: Report
) -> tuple[list[ResultRow], list[ScoredView]]:
    """Rows of both protocols, and novel views to show: of different cars, evenly spread."""
    description = describe_model(config.run)
    lpips, reason = load_lpips()
    all_rows: list[ResultRow] = []
    shown: dict[str, ScoredView] = {}
    for protocol in PROTOCOLS:
        evaluation = EvaluationConfig(protocol=protocol, limit=SCORED_IMAGES)
        pairs = view_pairs(store, evaluation)
        rows = []
        for view in score_views(model, store, pairs, lpips=lpips, report=report, description=f"score {protocol}"):
            rows.append(
                result_row(
                    view,
                    evaluation,
                    method="car-nerf-small",
                    steps=int(description.provenance["step"]),
                    data_sha256=store.data_sha256,
                    checkpoint_sha256=description.sha256,
                )
            )
            if protocol == "novel-view":
                shown.setdefault(view.pair.instance_id, view)
        header = ResultHeader(command="carstudio demo", reasons={} if lpips else {"lpips": str(reason)})
        write_rows(config.out / f"{protocol}.jsonl", rows, header)
        all_rows += rows
    return all_rows, list(shown.values())[:8]


def _turn(config: DemoConfig, model: CategoryModel, store: PatchStore, report: Report) -> list[Picture]:
    """A GIF per unseen car: the input photo beside the car turning."""
    first: dict[str, str] = {}
    for patch_id in store.patch_ids(split="instance", part="test"):
        first.setdefault(patch_id.rsplit("-", 1)[0], patch_id)
    pictures = []
    chosen = list(first.values())[:TURNTABLES]
    for done, patch_id in enumerate(chosen, start=1):
        prepared, latents, box = encode_patch(model, store, patch_id)
        frames = turntable(model, latents, box, views=30, size_px=160)
        photo = fit(prepared.rgb.numpy(), 160, 160)
        path = config.out / "turntables" / f"{patch_id}.gif"
        write_gif(path, [np.concatenate([photo, frame], axis=1) for frame in frames.rgb], fps=10.0)
        pictures.append(Picture(source=path.read_bytes(), caption=patch_id, alt="photo, and the car turning"))
        report("turntables", done, len(chosen), patch_id)
    return pictures


def _write_report(
    config: DemoConfig,
    store: PatchStore,
    summary: dict[str, Any],
    rows: list[ResultRow],
    views: list[ScoredView],
    turned: list[Picture],
) -> None:
    summaries = summarise(rows)
    tables = result_tables(summaries, intervals=True)
    novel = summaries[0].metrics
    sheet = views_sheet(views)
    write_png(config.out / "novel-views.png", sheet)
    write_text(config.out / "table.md", "\n".join(to_markdown(table) for table in tables))
    tested = summaries[0].num_instances
    page = Page(
        title="Car-Studio demo",
        lead=(
            f"{config.cars} synthetic cars were photographed from {config.views} sides each; car-nerf-small was "
            f"trained for {summary['seconds'] / 60:.1f} minutes on nine tenths of them and then shown one photo each "
            f"of {tested} cars that it had never seen."
        ),
        figures=[
            KeyFigure(value=f"{novel['psnr'].mean:.1f} dB", label="PSNR", detail="novel views of unseen cars"),
            KeyFigure(value=f"{novel['ssim'].mean:.3f}", label="SSIM", detail="the same views"),
            KeyFigure(value=f"{novel['mask_iou'].mean:.3f}", label="mask IoU", detail="the same views"),
            KeyFigure(value=f"{summary['rays_per_s']:,.0f}", label="training rays/s", detail="on this machine"),
        ],
        sections=[
            Section(
                title="Cars never seen, from sides never shown",
                blocks=[Picture(source=encode_png(sheet), caption="The model saw the left photo only.")],
            ),
            Section(title="Turntables", blocks=[Gallery(turned, min_width_px=260)]),
            Section(title="Scores", blocks=tables),
            Section(
                title="Training",
                blocks=[Picture(source=learning_curve(read_log(config.run / "log.jsonl")), caption="Learning curve")],
            ),
            Section(title="The same by hand", blocks=[Text("Each step as a command:"), Commands(config.commands())]),
        ],
        footer=[
            ("steps", f"{summary['steps']:,}"),
            ("seed", str(config.seed)),
            ("data", store.data_sha256[:16]),
            ("model", str(summary["sha256"])[:16]),
        ],
    )
    write_page(config.out / "index.html", page)
