"""`carstudio dataset export|card|report`: a store in other formats, and for reading."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.card import write_card
from carstudio.dataset.export_coco import export_coco
from carstudio.dataset.export_folder import Which
from carstudio.dataset.export_kitti import export_kitti
from carstudio.dataset.legacy_json.exporter import export_legacy
from carstudio.dataset.store import open_store


@dataclass(frozen=True, kw_only=True)
class Export(Output):
    """Write the kept patches in another format."""

    store: tyro.conf.Positional[Path]
    """The store."""
    out: Path
    """A new or empty folder."""
    format: Literal["legacy-json", "coco", "kitti"] = "legacy-json"
    """legacy-json: CarPatch3D as the authors published it; what came from their files is written as it was. coco:
    images/ and annotations.json with masks as run lengths. kitti: image_2, label_2, calib. The pictures are the crops,
    and all positions are in pixels of the crop."""
    patches: Which = "kept"
    """Kept patches, or rejected ones too."""

    def saved(self) -> str:
        """The pictures that an export has written."""
        return f"the pictures so far are saved in {self.out}"

    def run(self) -> Outcome:
        """Say what was written and what was left out."""
        with self.progress() as report:
            export = {"legacy-json": export_legacy, "coco": export_coco, "kitti": export_kitti}[self.format]
            summary = export(open_store(self.store), self.out, patches=self.patches, report=report)
        lines = [f"{summary.out / name}: {count} patches" for name, count in summary.files.items()]
        lines += [f"  left out: {count:6d}  {reason}" for reason, count in summary.left_out.items()]
        return Outcome("\n".join(lines), plain(summary))


@dataclass(frozen=True, kw_only=True)
class Card(Output):
    """Write README.md into the store: a Hugging Face dataset card with a ledger of sources and licences."""

    store: tyro.conf.Positional[Path]
    """The store."""
    title: str = ""
    """Its heading; the folder's name when empty."""
    force: bool = False
    """Replace a README.md that is there."""

    def run(self) -> Outcome:
        """Write the card."""
        path = write_card(open_store(self.store), title=self.title, force=self.force)
        return Outcome(f"the card is {path}", {"card": str(path)})


@dataclass(frozen=True, kw_only=True)
class DatasetReport(Output):
    """Write one HTML page: verdicts, distributions with thresholds, viewpoints, cameras, pictures per reason."""

    store: tyro.conf.Positional[Path]
    """The store."""
    out: Path
    """Folder for index.html and pictures/."""
    per_reason: int = 24
    """Pictures per verdict reason, evenly spread over the store."""

    def run(self) -> Outcome:
        """Write the page."""
        from carstudio.report.build_page import BuildPageConfig, write_build_report  # matplotlib: the others need none

        config = BuildPageConfig(per_reason=self.per_reason)
        with self.progress() as report:
            page = write_build_report(self.store, self.out, config=config, report=report)
        return Outcome(f"the report is {page}", {"page": str(page)})
