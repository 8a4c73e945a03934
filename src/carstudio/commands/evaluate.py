"""`carstudio evaluate`: a trained model scored by one protocol, one row per image."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from carstudio.commands.command import Outcome, Output, plain, provenance
from carstudio.dataset.store import open_store
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.evaluation.protocols import EvaluationConfig, Protocol
from carstudio.evaluation.scored_run import score_run
from carstudio.evaluation.summary import summarise
from carstudio.evaluation.tables import result_tables, to_markdown
from carstudio.files import require_writable
from carstudio.training.checkpoint import describe_model, load_model


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
        model, description = load_model(self.model, device=pick_device(self.device)), describe_model(self.model)
        config = EvaluationConfig(protocol=self.protocol, limit=self.limit, seed=self.seed, **parse_split(self.split))
        require_writable(self.out)
        with self.progress() as report:
            scored = score_run(
                model, description, open_store(self.data), config, command=provenance()["command"], report=report
            )
        scored.write(self.out)
        summaries = summarise(scored.rows)
        tables = "\n".join(to_markdown(table) for table in result_tables(summaries, intervals=True))
        return Outcome(tables, {"rows": len(scored.rows), "summary": plain(summaries)})


def parse_split(text: str) -> dict[str, Any]:
    """{"split", "part"} of NAME:part."""
    if text == "none":
        return {"split": None, "part": "all"}
    name, _, part = text.partition(":")
    if part not in ("train", "test", "all") or not name:
        raise InputError(f"--split {text!r}: expected NAME:train, NAME:test, NAME:all or none")
    return {"split": name, "part": part}
