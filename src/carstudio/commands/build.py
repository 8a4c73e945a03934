"""`carstudio build`: labelled photographs -> CarPatch3D."""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.build import BuildConfig, SourceKind, build
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.sources.frame import CameraOffset
from carstudio.dataset.summary import BuildSummary
from carstudio.dataset.writer import count_patches, shard_paths
from carstudio.progress import Report

_SHOWN_PROBLEMS = 20


@dataclass(frozen=True, kw_only=True)
class Build(Output):
    """Make a CarPatch3D store: crops, boxes, masks, cameras, and a verdict with its reason for every candidate."""

    source: tyro.conf.Positional[SourceKind]
    """Kind of input; photos: pictures of any origin; legacy-json: CarPatch3D as the authors published it."""
    root: str
    """Folder of the source in its official layout; photos: a folder, a 'pattern/**/*.jpg', a list (txt, csv, parquet),
    a URL; legacy-json: a json file, or the folder with km.json, ko.json ..."""
    out: Path
    """The store to write."""
    frames: str | None = None
    """Frame numbers A-B, both included (photos: counted from 0); all when absent."""
    sequence: str | None = None
    """KITTI-MOT: one sequence, such as 0001; all when absent."""
    subset: str | None = None
    """legacy-json: one of km, ko, dv, vk, ns; all that are there when absent."""
    camera_offset: CameraOffset = "exact"
    """exact: boxes are moved by K^-1 P2[:, 3], as KITTI's projection says; as-released: they are not."""
    detector: str | None = None
    """Who finds 2-D boxes: labels, transformers[:NAME_OR_DIR], onnx:FILE (YOLOX), precomputed:FILE.json (COCO). Absent:
    the labels of KITTI, transformers for photos."""
    segmenter: str = "grabcut"
    """Who finds masks: grabcut (no weights), sam[:NAME_OR_DIR], sam2[:NAME_OR_DIR], onnx:FILE (semantic segmentation),
    precomputed:FOLDER (PNG), precomputed:FILE.json (COCO)."""
    box3d: str | None = None
    """Who finds 3-D boxes: labels, dd3d:FOLDER (made by `models convert dd3d`), precomputed:FOLDER (KITTI text),
    precomputed:FILE.json (DD3D's), none. Absent: the labels of KITTI, none for photos."""
    camera: str | None = None
    """photos: exif (the default), paper, FOCAL_PX, FX,FY,CX,CY or calib:PATH (KITTI calibration)."""
    licence: str | None = None
    """photos: their licence, such as CC-BY-4.0."""
    filters: tyro.conf.OmitArgPrefixes[FilterRecipe] = field(default_factory=FilterRecipe)
    """Thresholds; the released ones by default. legacy-json takes none: `dataset refilter` judges it again."""
    workers: int = 0
    """Processes; 0: one per core, one where networks run on a GPU. Each has its own copy of the networks (SAM ViT-H:
    2.6 GB)."""

    report: bool = True
    """Write OUT/report/index.html: counts per reason, distributions, viewpoints, cameras, pictures of each verdict."""

    def saved(self) -> str:
        """The whole shards."""
        return describe_unfinished(self.out)

    def run(self) -> Outcome:
        """Build and say what was kept and why the rest was not."""
        config = BuildConfig(
            source=self.source,
            root=self.root,
            out=self.out,
            frames=self.frames,
            sequence=self.sequence,
            subset=self.subset,
            camera_offset=self.camera_offset,
            detector=self.detector,
            segmenter=self.segmenter,
            box3d=self.box3d,
            camera=self.camera,
            licence=self.licence,
            filters=self.filters,
            workers=self.workers,
        )
        with self.progress() as report:
            summary = build(config, report)
            page = self._write_report(summary, report) if self.report else None
        text = describe(summary) if page is None else f"{describe(summary)}\nreport: {page}"
        return Outcome(text, {**plain(summary), "report": None if page is None else str(page)})

    def _write_report(self, summary: BuildSummary, report: Report) -> Path:
        from carstudio.report.build_page import write_build_report

        return write_build_report(self.out, self.out / "report", problems=summary.problems, report=report)


def describe_unfinished(out: Path) -> str:
    """What a stopped `build` or `synth` leaves."""
    return f"{sum(count_patches(path) for path in shard_paths(out))} patches in whole shards are saved in {out}"


def describe(summary: BuildSummary) -> str:
    """A build's counts as a few lines of text."""
    lines = [
        f"{summary.out}: {summary.candidates} candidates in {summary.seconds:.1f} s, {summary.kept} kept "
        f"({summary.instances} cars)"
    ]
    lines += [f"  {count:6d}  {reason}" for reason, count in summary.reasons.items()]
    lines += [f"  split {name}: {parts}" for name, parts in summary.splits.items()]
    lines += [f"  problem: {problem}" for problem in summary.problems[:_SHOWN_PROBLEMS]]
    if len(summary.problems) > _SHOWN_PROBLEMS:
        lines.append(f"  ... and {len(summary.problems) - _SHOWN_PROBLEMS} more problems; --json lists them all")
    return "\n".join(lines)
