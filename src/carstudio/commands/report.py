"""`carstudio report`: a trained model scored by both protocols, with pictures, on one HTML page."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import tyro

from carstudio.commands.command import Outcome, Output, plain, split_of
from carstudio.dataset.store import open_store
from carstudio.evaluation.tables import result_tables, to_markdown
from carstudio.report.run_page import RunPageConfig, write_run_page


@dataclass(frozen=True, kw_only=True)
class WriteReport(Output):
    """Score a trained model by both protocols and write index.html, rows, table, pictures and turntables."""

    model: tyro.conf.Positional[Path]
    """Folder of the run."""
    data: Path
    """The CarPatch3D store."""
    out: Path
    """Folder of the report; index.html in it is the page."""
    page: tyro.conf.OmitArgPrefixes[RunPageConfig] = field(default_factory=RunPageConfig)
    """What is scored and shown."""

    def saved(self) -> str:
        """The page comes last."""
        return "no page was written: it is written at the end"

    def run(self) -> Outcome:
        """Score, draw and write."""
        page = replace(self.page, split=split_of(self.page.split))
        with self.progress() as report:
            summaries = write_run_page(self.model, open_store(self.data), self.out, page, report=report)
        tables = "\n".join(to_markdown(table) for table in result_tables(summaries, intervals=True))
        index = self.out / "index.html"
        return Outcome(f"{tables}\nreport: {index}", {"report": str(index), "summary": plain(summaries)})
