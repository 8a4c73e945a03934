"""The report of a trained model on a store: both protocols, pictures, learning curve, turntables, one HTML page."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from carstudio.dataset.pixels import PreparedPatch
from carstudio.dataset.store import PatchStore
from carstudio.devices import pick_device
from carstudio.evaluation.protocols import EvaluationConfig, Protocol, ScoredView, can_score
from carstudio.evaluation.scored_run import ScoredRun, score_run
from carstudio.evaluation.summary import Summary, summarise
from carstudio.evaluation.tables import result_tables, to_markdown
from carstudio.files import inside, require_writable, write_text
from carstudio.images import encode_png, to_uint8, write_png
from carstudio.models.interface import CategoryModel
from carstudio.progress import Report, silent
from carstudio.report.overlays import draw_box3d, draw_mask
from carstudio.report.page import Commands, Gallery, KeyFigure, Page, Picture, Section, Text, write_page
from carstudio.report.panels import encode_patch, truth_on_black, turntable, views_sheet
from carstudio.report.plots import learning_curve
from carstudio.report.sheets import Pixels, fit, side_by_side
from carstudio.report.video import write_gif
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.log import LOG, read_log

PROTOCOLS: tuple[Protocol, ...] = ("novel-view", "input-view")
CHECK_HEADS = ("photo and 3-D box", "mask", "truth", "input view", "another photo", "novel view from it")
ENLARGED_PX = 256


@dataclass(frozen=True, kw_only=True)
class RunPageConfig:
    """What a report shows."""

    split: str | None = "instance"
    """Split whose test part is scored; None: all kept patches."""
    limit: int | None = None
    """Score at most this many images per protocol, evenly spread."""
    turntables: int = 6
    """Cars shown turning."""
    seed: int = 0
    """Chooses each scored view's input view."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def evaluation(self, protocol: Protocol) -> EvaluationConfig:
        """The same for one protocol."""
        part: Any = "test" if self.split else "all"
        return EvaluationConfig(protocol=protocol, split=self.split, part=part, limit=self.limit, seed=self.seed)


def write_run_page(
    run: Path,
    store: PatchStore,
    out: Path,
    config: RunPageConfig,
    *,
    title: str = "",
    lead: str = "",
    commands: Sequence[str] = (),
    report: Report = silent,
) -> list[Summary]:
    """Score a trained model and write `index.html`, rows, table and pictures into `out`; returns the summaries."""
    model, description = load_model(run, device=pick_device(config.device)), describe_model(run)
    require_writable(out / "index.html")
    evaluations = [config.evaluation(protocol) for protocol in PROTOCOLS]
    command = shlex.join(["carstudio", "report", str(run), "--data", str(store.path)])
    scored = {
        evaluation.protocol: score_run(model, description, store, evaluation, command=command, report=report)
        for evaluation in evaluations
        if can_score(store, evaluation) or evaluation.protocol == "input-view"
    }
    for protocol, found in scored.items():
        found.write(out / f"{protocol}.jsonl")
    summaries = summarise([row for found in scored.values() for row in found.rows])
    tables = result_tables(summaries, intervals=True)
    write_text(out / "table.md", "\n".join(to_markdown(table) for table in tables))
    page = Page(
        title=title or f"{description.provenance.get('recipe', run.name)} on {store.path.name}",
        lead=lead or _lead(summaries, description.provenance),
        figures=_key_figures(summaries[0]),
        sections=[
            *_picture_sections(scored, out),
            _turntables(model, store, next(iter(scored.values())), out, config.turntables, report),
            Section(title="Scores", blocks=list(tables)),
            _training(run, list(commands) or [str(description.provenance.get("command", ""))]),
        ],
        footer=[
            ("steps", f"{description.provenance.get('step', 0):,}"),
            ("precision", str(description.provenance.get("precision", "float32"))),
            ("began with", str(description.provenance.get("starts_from", ""))),
            ("data", store.data_sha256[:16]),
            ("model", description.sha256[:16]),
        ],
    )
    write_page(out / "index.html", page)
    return summaries


def _lead(summaries: list[Summary], provenance: dict[str, Any]) -> str:
    novel = summaries[0]
    return (
        f"{novel.num_images} views of {novel.num_instances} cars ({novel.split}), scored by both protocols after "
        f"{provenance.get('step', 0):,} training steps."
    )


def _key_figures(novel: Summary) -> list[KeyFigure]:
    forms = {"psnr": ("PSNR", "{:.1f} dB"), "ssim": ("SSIM", "{:.3f}"), "mask_iou": ("mask IoU", "{:.3f}")}
    detail = f"{novel.protocol}, {novel.split}"
    return [
        KeyFigure(value=form.format(novel.metrics[name].mean), label=label, detail=detail)
        for name, (label, form) in forms.items()
        if name in novel.metrics
    ]


def _picture_sections(scored: dict[Protocol, ScoredRun], out: Path) -> list[Section]:
    sections = []
    if "novel-view" in scored:
        novel = views_sheet(scored["novel-view"].shown)
        write_png(out / "novel-views.png", novel)
        picture = Picture(source=encode_png(novel), caption="The model saw the left photo only.")
        sections.append(Section(title="Novel views", blocks=[picture]))
    checks = check_sheet(scored["novel-view"].shown if "novel-view" in scored else [], scored["input-view"].shown)
    write_png(out / "checks.png", checks)
    caption = "A photo with its 3-D box (front face crossed) and mask, and the car encoded from it in the same view"
    if "novel-view" in scored:
        caption += "; then another photo of the car, and the car encoded from that one"
    picture = Picture(source=encode_png(checks), caption=caption + ".")
    return [*sections, Section(title="From photo to car", blocks=[picture])]


def check_sheet(novel: Sequence[ScoredView], same: Sequence[ScoredView]) -> Pixels:
    """One row per photo: its box, mask, pixels, its input view and, where it was scored by both protocols, novel view.

    Rows are the views of `novel` that are in `same` too, or all of `same` when `novel` is empty.
    """
    by_patch = {view.pair.scored_patch_id: view for view in same}
    both = [(by_patch[view.pair.scored_patch_id], [view]) for view in novel if view.pair.scored_patch_id in by_patch]
    chosen = both or [(view, []) for view in same]
    return side_by_side(
        [_check_row(view, others) for view, others in chosen],
        heads=CHECK_HEADS if both else CHECK_HEADS[:4],
        captions=[view.pair.scored_patch_id for view, _ in chosen],
    )


def _check_row(view: ScoredView, others: Sequence[ScoredView]) -> list[Pixels]:
    patch = view.scored_patch
    pictures = [
        boxed_photo(patch),
        draw_mask(patch.rgb.numpy(), patch.mask.numpy()),
        truth_on_black(patch),
        to_uint8(view.rgb.numpy()),
    ]
    for other in others:
        pictures += [other.input_patch.rgb.numpy(), to_uint8(other.rgb.numpy())]
    return pictures


def boxed_photo(patch: PreparedPatch) -> Pixels:
    """The crop, enlarged so that lines stay thin, with the wireframe of its 3-D box."""
    height, width = patch.mask.shape
    scale = max(1, round(ENLARGED_PX / max(height, width)))
    enlarged = fit(patch.rgb.numpy(), width * scale, height * scale)
    return draw_box3d(enlarged, patch.box, patch.camera.resize(width * scale, height * scale))


def _turntables(
    model: CategoryModel, store: PatchStore, scored: ScoredRun, out: Path, count: int, report: Report
) -> Section:
    """A GIF per car: the input photo beside the car turning."""
    first: dict[str, str] = {}
    for view in scored.shown:
        first.setdefault(view.pair.instance_id, view.pair.input_patch_id)
    chosen = list(first.values())[:count]
    pictures = []
    for done, patch_id in enumerate(chosen, start=1):
        prepared, latents, box = encode_patch(model, store, patch_id)
        frames = turntable(model, latents, box, views=30, size_px=160)
        photo = fit(prepared.rgb.numpy(), 160, 160)
        path = inside(out / "turntables", f"{patch_id}.gif")
        write_gif(path, [np.concatenate([photo, frame], axis=1) for frame in frames.rgb], fps=10.0)
        pictures.append(Picture(source=path.read_bytes(), caption=patch_id, alt="photo, and the car turning"))
        report("turntables", done, len(chosen), patch_id)
    return Section(title="Turntables", blocks=[Gallery(pictures, min_width_px=260)])


def _training(run: Path, commands: list[str]) -> Section:
    log = run / LOG  # a bundled model comes without
    curve = [Picture(source=learning_curve(read_log(log)), caption="Learning curve")] if log.exists() else []
    return Section(title="Training", blocks=[*curve, Text("The commands:"), Commands(commands)])
