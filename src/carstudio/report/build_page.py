"""The report of a build: what was kept, why the rest was not, and pictures of both, as one HTML page.

Works for stores of any size: light columns are read whole, pictures only of the patches that are shown.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carstudio.dataset.duplicates import read_duplicates
from carstudio.dataset.measured import Measured, measure, reasons_in_order
from carstudio.dataset.store import PatchStore, open_store
from carstudio.dataset.verdicts import KEPT
from carstudio.errors import InputError
from carstudio.files import inside, require_writable, write_bytes
from carstudio.images import encode_png
from carstudio.progress import Report, silent
from carstudio.report.build_tables import (
    camera_kind,
    camera_sentence,
    camera_table,
    dataset_tables,
    licence_table,
    reason_table,
)
from carstudio.report.distributions import Distribution, histograms, viewpoint_rose
from carstudio.report.page import KeyFigure, Page, Picture, Section, Text, write_page
from carstudio.report.patch_sheets import patches_sheet, reason_sheet, spread
from carstudio.report.plots import bars

# Value -> what a histogram of it is called, in the order of the page; other filters' values follow by their names.
TITLES = {
    "height_px": "2-D box: height (px)",
    "width_px": "2-D box: width (px)",
    "depth_m": "Depth of the 3-D box (m)",
    "score_2d": "Score of the 2-D box",
    "score_mask": "Score of the mask",
    "score_3d": "Score of the 3-D box",
    "viewpoint_deg": "Yaw against the source's viewpoint (°)",
    "mask_ratio": "Car pixels / pixels of the crop",
    "box_iou": "IoU of 2-D and projected box",
    "yaw_deg": "Yaw, KITTI's rotation_y (°)",
    "azimuth_deg": "Viewing azimuth (°), 0 front",
    "elevation_deg": "Viewing elevation (°)",
    "length_m": "Length (m)",
    "height_m": "Height (m)",
    "width_m": "Width (m)",
    "truncation": "Truncation",
    "occlusion": "Occlusion (level)",
}
_NO_DISTRIBUTION = ("box3d", "type", "centred", "crop_width", "crop_height")
MOST_PAIRS = 12  # of like pictures
MOST_PROBLEMS = 200  # told on the page
MOST_PICTURES = 1000  # per reason: a sheet is held in memory and in the page
ROSE_NOTE = (
    "Where the camera stands around the car, seen from above with the car's front up: azimuth 0° looks at the front, "
    "90° at the car's left side, 180° at the rear. It is the camera's direction from the centre of the 3-D box, in the "
    "car's frame, so a car at the picture's border counts as it is seen, not as it is headed."
)


@dataclass(frozen=True, kw_only=True)
class BuildPageConfig:
    """How much a report shows."""

    per_reason: int = 24
    """Pictures per verdict reason, evenly spread over the store."""

    def __post_init__(self) -> None:
        if not 1 <= self.per_reason <= MOST_PICTURES:
            raise InputError(f"--per-reason must be 1 to {MOST_PICTURES}, found {self.per_reason}")


def write_build_report(
    store_path: Path | str,
    out: Path | str,
    *,
    config: BuildPageConfig | None = None,
    problems: Sequence[str] = (),
    title: str = "",
    report: Report = silent,
) -> Path:
    """Write `index.html` and `pictures/` of a store into `out`; returns the page's path.

    `problems` are what the build skipped, one sentence each (`BuildSummary.problems`).
    """
    store, out = open_store(store_path), Path(out)
    require_writable(out / "index.html")
    measured = measure(store)
    album = Album(out)
    config = config or BuildPageConfig()
    page = Page(
        title=title or f"Build of {store.path.name}",
        lead=_lead(measured, store),
        figures=_key_figures(measured),
        sections=[
            _verdicts(measured, album),
            *([_distributions(measured, album), _viewpoints(measured, album)] if len(measured) else []),
            Section(title="Dataset", blocks=[*dataset_tables(measured), licence_table(measured)]),
            _cameras(measured, album),
            *_duplicates(store, measured, album),
            *_sheets(store, measured, album, config, report),
            *_problems(problems),
        ],
        footer=[("patches", f"{len(measured):,}"), ("data", store.data_sha256[:16])],
    )
    write_page(out / "index.html", page)
    return out / "index.html"


@dataclass(frozen=True)
class Album:
    """Pictures of a page: embedded, and as files in `pictures/` beside it."""

    out: Path

    def add(self, name: str, data: bytes, *, caption: str, alt: str = "") -> Picture:
        """Write `pictures/NAME.png`; the same picture for the page."""
        write_bytes(inside(self.out / "pictures", f"{name}.png"), data)
        return Picture(source=data, caption=caption, alt=alt)


def _lead(measured: Measured, store: PatchStore) -> str:
    sources = ", ".join(sorted(set(measured.source.tolist()))) or "no source"
    unfinished = "" if store.manifest.is_finished else " The store is unfinished: its build was interrupted."
    return f"{len(measured):,} candidates from {sources}, {int(measured.is_kept.sum()):,} of them kept.{unfinished}"


def _key_figures(measured: Measured) -> list[KeyFigure]:
    kept = measured.is_kept
    total = max(1, int(kept.sum()))
    shares = [("with a 3-D box", measured.has_box), ("with a mask", measured.has_mask)]
    return [
        KeyFigure(value=f"{int(kept.sum()):,}", label="kept patches", detail=f"of {len(measured):,} candidates"),
        KeyFigure(value=f"{len(set(measured.instance_id[kept].tolist())):,}", label="cars", detail="with a kept patch"),
        *(
            KeyFigure(value=f"{100 * (has & kept).sum() / total:.0f} %", label=label, detail="of the kept")
            for label, has in shares
        ),
    ]


def _verdicts(measured: Measured, album: Album) -> Section:
    counts = {
        f"{reason} ({measured.thresholds[reason].text})" if reason in measured.thresholds else reason: float(count)
        for reason, count in reasons_in_order(measured)
    }
    blocks: list[Picture | Text] = []
    if counts:
        data = bars(counts, title="Patches per reason")
        blocks.append(album.add("reasons", data, caption="Kept, or the first filter that failed"))
    return Section(title="Verdicts", blocks=[*blocks, reason_table(measured)])


def _distributions(measured: Measured, album: Album) -> Section:
    others = sorted(measured.values.keys() - TITLES.keys() - set(_NO_DISTRIBUTION))
    shown = []
    for name in (*TITLES, *others):
        values, limit = measured.values[name], measured.thresholds.get(name)
        if not np.isfinite(values).any():
            continue
        shown.append(
            Distribution(
                title=TITLES.get(name, name),
                values=values,
                is_kept=measured.is_kept,
                thresholds=() if limit is None else limit.values,
                limit_text="" if limit is None else f"asked: {limit.text}",
            )
        )
    unknown = [title for name, title in TITLES.items() if not np.isfinite(measured.values[name]).any()]
    text = "Kept and rejected patches stacked; the outermost bins also count what lies beyond them."
    text += f" Unknown for all patches: {'; '.join(unknown)}." if unknown else ""
    picture = album.add("distributions", histograms(shown), caption=text, alt="histograms of the measured values")
    return Section(title="What was measured", blocks=[picture])


def _viewpoints(measured: Measured, album: Album) -> Section:
    if not measured.has_box.any():
        return Section(title="Viewpoints", blocks=[Text("No patch has a 3-D box: nobody knows how the cars are seen.")])
    rose = viewpoint_rose(measured.values["azimuth_deg"], measured.is_kept)
    return Section(title="Viewpoints", blocks=[album.add("viewpoints", rose, caption=ROSE_NOTE, alt="viewpoint rose")])


def _cameras(measured: Measured, album: Album) -> Section:
    blocks: list[Text | Picture] = [Text(camera_sentence(measured))] if len(measured) else []
    kinds = np.array([camera_kind(source) for source in measured.camera_source.tolist()])
    limit = measured.thresholds.get("box_iou")
    shown = [
        Distribution(
            title=f"box_iou, camera {kind}",
            values=measured.values["box_iou"][kinds == kind],
            is_kept=measured.is_kept[kinds == kind],
            thresholds=() if limit is None else limit.values,
            limit_text="" if limit is None else f"asked: {limit.text}",
        )
        for kind in sorted(set(kinds.tolist()))
    ]
    if np.isfinite(measured.values["box_iou"]).any():
        caption = "How far 2-D box and projected 3-D box agree, per kind of camera"
        blocks.append(album.add("cameras", histograms(shown), caption=caption))
    return Section(title="Cameras", blocks=[camera_table(measured), *blocks])


def _duplicates(store: PatchStore, measured: Measured, album: Album) -> list[Section]:
    """Counts, and the first groups of like pictures side by side; nothing where nobody has looked for them."""
    found = read_duplicates(store)
    if found is None:
        return [
            Section(title="Duplicates", blocks=[Text("Nobody has looked for them; carstudio dataset duplicates does.")])
        ]
    told = (
        "{groups:,} groups of like pictures: {exact:,} patches are the same as another byte for byte, {near:,} nearly."
    )
    blocks: list[Text | Picture] = [Text(f"{told.format(**found.counts())} A group is on one side of every split.")]
    groups: dict[int, list[int]] = {}
    places = {patch_id: index for index, patch_id in enumerate(measured.patch_id.tolist())}
    for patch_id, number in found.groups().items():
        groups.setdefault(number, []).append(places[patch_id])
    chosen = [list(groups.values())[i][:2] for i in spread(len(groups), MOST_PAIRS)]
    sheet = patches_sheet(store, measured, [index for pair in chosen for index in pair])
    if sheet is not None:
        caption = f"Two patches each of {len(chosen)} groups, evenly spread; pairs stand side by side"
        blocks.append(album.add("duplicates", encode_png(sheet), caption=caption))
    return [Section(title="Duplicates", blocks=blocks)]


def _sheets(
    store: PatchStore, measured: Measured, album: Album, config: BuildPageConfig, report: Report
) -> list[Section]:
    sections = []
    for reason, count in reasons_in_order(measured):
        sheet = reason_sheet(store, measured, reason, most=config.per_reason, report=report)
        if sheet is None:
            continue
        limit = measured.thresholds.get(reason)
        caption = f"{min(config.per_reason, count):,} of {count:,} patches, evenly spread over the store. "
        caption += "Pink: 2-D box. Blue: 3-D box, its front orange and crossed. Green: mask; grey stripes: unknown."
        title = "Kept" if reason == KEPT else f"Rejected: {reason}" + ("" if limit is None else f" ({limit.text})")
        picture = album.add(f"sheet-{reason}", encode_png(sheet), caption=caption, alt=f"patches: {reason}")
        sections.append(Section(title=title, blocks=[picture]))
    return sections


def _problems(problems: Sequence[str]) -> list[Section]:
    if not problems:
        return []
    told = "\n\n".join(problems[:MOST_PROBLEMS])
    if len(problems) > MOST_PROBLEMS:
        told += f"\n\n... and {len(problems) - MOST_PROBLEMS:,} more"
    return [Section(title=f"Problems ({len(problems):,})", blocks=[Text(told)])]
