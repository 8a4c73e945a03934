"""One row of a table: trained if it is not yet, scored if it is not yet, both from where they were left."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from carstudio.comparison.rows import Row
from carstudio.dataset.store import PatchStore
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.evaluation.protocols import EvaluationConfig, Protocol, can_score
from carstudio.evaluation.results import ResultHeader, ResultRow, read_header, read_rows
from carstudio.evaluation.scored_run import score_run
from carstudio.files import parse_json, read_json, write_json
from carstudio.models.interface import CategoryModel
from carstudio.progress import Report, silent
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.resume import has_state
from carstudio.training.trainer import train

PROTOCOLS: tuple[Protocol, ...] = ("novel-view", "input-view")
SETTINGS, SUMMARY = "row.json", "summary.json"


@dataclass(frozen=True, kw_only=True)
class Work:
    """What all rows of a table share."""

    store: PatchStore
    out: Path
    split: str
    limit: int | None = None
    seed: int = 0
    device: str = "auto"
    processes: int = 1
    command: str = ""
    report: Report = silent
    should_stop: Callable[[], bool] = lambda: False

    def folder(self, row: Row) -> Path:
        """Where a row's model and scores are."""
        return self.out / "runs" / row.name

    def evaluation(self, protocol: Protocol, row: Row) -> EvaluationConfig:
        """What is scored: the split's test part, of cars with as many training photos as the row asks for."""
        least = row.config.least_views if self.split == "view" else 0
        return EvaluationConfig(
            protocol=protocol, split=self.split, part="test", limit=self.limit, seed=self.seed, least_train_views=least
        )


@dataclass(frozen=True)
class Finished:
    """A trained and scored row: its training's summary, parameters, and the scores of all images."""

    row: Row
    summary: dict[str, Any]
    num_parameters: int
    scores: list[ResultRow]
    header: ResultHeader


def finish_row(work: Work, row: Row) -> Finished:
    """Train and score what is missing; `InputError` when the folder holds this row with other settings."""
    row, summary = train_row(work, row)
    folder = work.folder(row)
    scores = [found for protocol in PROTOCOLS for found in _scores(work, row, protocol)]
    return Finished(row, summary, _num_parameters(folder), scores, _header(folder))


def train_row(work: Work, row: Row) -> tuple[Row, dict[str, Any]]:
    """Train a row where that is missing; the row as it was trained, and its training's summary."""
    row = replace(row, config=replace(row.config, seed=work.seed, split=work.split))
    folder = work.folder(row)
    _claim(work, row, folder)
    if not (folder / SUMMARY).exists():
        summary = train(
            row.config,
            work.store,
            folder,
            device=work.device,
            resume=has_state(folder),
            provenance={"command": work.command, "data_sha256": work.store.data_sha256},
            report=lambda what, done, total, note: work.report(f"train {row.name}", done, total, note),
            should_stop=work.should_stop,
            processes=min(work.processes, row.config.patches_per_step),
        )
        write_json(folder / SUMMARY, asdict(summary))
    return row, dict(read_json(folder / SUMMARY))


def open_model(work: Work, row: Row) -> CategoryModel:
    """The row's trained model on the device."""
    return load_model(work.folder(row), device=pick_device(work.device))


def _claim(work: Work, row: Row, folder: Path) -> None:
    """Write down how the row is made; refuse a folder where it was made otherwise."""
    asked = {
        "training": asdict(row.config),
        "evaluation": [asdict(work.evaluation(protocol, row)) for protocol in PROTOCOLS],
        "data_sha256": work.store.data_sha256,
    }
    asked = parse_json(json.dumps(asked), name=row.name)  # tuples as lists, as they come back from a file
    path = folder / SETTINGS
    if not path.exists():
        write_json(path, asked)
        return
    found = read_json(path)
    if found != asked:
        different = _differences(found, asked)
        raise InputError(
            f"{folder}: this row was begun with other settings ({different}); give the same ones, or another --out"
        )


def _differences(found: Any, asked: Any, name: str = "") -> str:
    if isinstance(found, dict) and isinstance(asked, dict):
        keys = [key for key in sorted(found.keys() | asked.keys()) if found.get(key) != asked.get(key)]
        return ", ".join(_differences(found.get(key), asked.get(key), f"{name}.{key}".lstrip(".")) for key in keys[:3])
    return f"{name} {found!r} and not {asked!r}"[:160]


def _scores(work: Work, row: Row, protocol: Protocol) -> list[ResultRow]:
    """The row's scores by one protocol, from its file or now; none where there is nothing to score."""
    path = work.folder(row) / f"{protocol}.jsonl"
    config = work.evaluation(protocol, row)
    if not path.exists():
        if not can_score(work.store, config):
            return []
        folder = work.folder(row)
        found = score_run(
            open_model(work, row),
            describe_model(folder),
            work.store,
            config,
            command=work.command,
            report=lambda what, done, total, note: work.report(f"{what} {row.name}", done, total, note),
        )
        found.write(path)
    return read_rows(path)


def _header(folder: Path) -> ResultHeader:
    for protocol in PROTOCOLS:
        if (folder / f"{protocol}.jsonl").exists():
            return read_header(folder / f"{protocol}.jsonl")
    return ResultHeader()


def _num_parameters(folder: Path) -> int:
    model = load_model(folder)
    return sum(parameter.numel() for parameter in model.parameters())
