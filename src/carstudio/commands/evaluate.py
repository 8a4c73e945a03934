"""`carstudio evaluate`: a trained model scored by one protocol, one row per image."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from carstudio.commands.command import Outcome, Output, plain, provenance
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.evaluation.perceptual import load_lpips
from carstudio.evaluation.protocols import EvaluationConfig, Protocol, result_row, score_views, view_pairs
from carstudio.evaluation.results import ResultHeader, write_rows
from carstudio.evaluation.summary import summarise
from carstudio.evaluation.tables import result_tables, to_markdown
from carstudio.files import require_writable
from carstudio.training.checkpoint import describe_model, load_model, pick_device


@dataclass(frozen=True, kw_only=True)
class Evaluate(Output):
    """Score a trained model: input-view (the released protocol) or novel-view (encode one view, score others)."""

    model: tyro.conf.Positional[Path]
    """Folder of the run."""
    data: Path
    """The CarPatch3D store."""
    protocol: Protocol
    """input-view or novel-view."""
    out: Path
    """Result rows, JSON lines; a header goes beside them."""
    split: str = "instance:test"
    """NAME:train, NAME:test or NAME:all; "none" for all kept patches."""
    limit: int | None = None
    """Score at most this many images, evenly spread."""
    seed: int = 0
    """Chooses each scored view's input view."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def saved(self) -> str:
        """Rows are written together when all images are scored."""
        return "no row was written: they are written together at the end"

    def run(self) -> Outcome:
        """Score, write rows and header, and print the table."""
        model = load_model(self.model, device=pick_device(self.device))
        description = describe_model(self.model)
        store = open_store(self.data)
        config = EvaluationConfig(protocol=self.protocol, limit=self.limit, seed=self.seed, **parse_split(self.split))
        pairs = view_pairs(store, config)
        require_writable(self.out)
        lpips, reason = load_lpips()
        with self.progress() as report:
            rows = [
                result_row(
                    view,
                    config,
                    method=str(description.provenance.get("recipe", self.model.name)),
                    steps=int(description.provenance.get("step", 0)),
                    data_sha256=store.data_sha256,
                    checkpoint_sha256=description.sha256,
                )
                for view in score_views(model, store, pairs, lpips=lpips, report=report)
            ]
        reasons = {} if lpips is not None else {"lpips": str(reason)}
        header = ResultHeader(command=provenance()["command"], reasons=reasons)
        write_rows(self.out, rows, header)
        summaries = summarise(rows)
        tables = "\n".join(to_markdown(table) for table in result_tables(summaries, intervals=True))
        return Outcome(tables, {"rows": len(rows), "summary": plain(summaries)})


def parse_split(text: str) -> dict[str, Any]:
    """{"split", "part"} of NAME:part."""
    if text == "none":
        return {"split": None, "part": "all"}
    name, _, part = text.partition(":")
    if part not in ("train", "test", "all") or not name:
        raise InputError(f"--split {text!r}: expected NAME:train, NAME:test, NAME:all or none")
    return {"split": name, "part": part}
