"""`carstudio dataset ACTION STORE`: look into a store, judge it again, make others of it. One class per action."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import subcommand

from carstudio.commands.command import Outcome, Output
from carstudio.commands.dataset_making import Duplicates, Merge, Split
from carstudio.commands.dataset_out import Card, DatasetReport, Export
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.judging import judge_store
from carstudio.dataset.runs import write_run
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Info(Output):
    """Count patches, cars, verdicts, splits, sources, licences and cameras."""

    store: tyro.conf.Positional[Path]
    """The store."""

    def run(self) -> Outcome:
        """Print the counts as JSON."""
        info = open_store(self.store).info()
        return Outcome(json.dumps(info, indent=2), info)


@dataclass(frozen=True, kw_only=True)
class Verify(Output):
    """Read everything and check checksums, pictures and boxes."""

    store: tyro.conf.Positional[Path]
    """The store."""

    def run(self) -> Outcome:
        """A store with problems is an error that lists them."""
        return verify(open_store(self.store))


@dataclass(frozen=True, kw_only=True)
class Refilter(Output):
    """Judge every patch again by its stored values and make the splits anew; no picture is read."""

    store: tyro.conf.Positional[Path]
    """The store."""
    filters: tyro.conf.OmitArgPrefixes[FilterRecipe] = field(default_factory=FilterRecipe)
    """Thresholds; the released ones by default."""

    def run(self) -> Outcome:
        """Replace verdicts and splits."""
        return refilter(open_store(self.store), self.filters)


def verify(store: PatchStore) -> Outcome:
    """Read everything and check it; a store with problems is an `InputError` that lists them."""
    problems = store.verify()
    if problems:
        raise InputError(f"{store.path}: {len(problems)} problems\n" + "\n".join(problems))
    return Outcome(f"{store.path}: {len(store)} patches, all sound", {"patches": len(store), "problems": []})


def refilter(store: PatchStore, recipe: FilterRecipe) -> Outcome:
    """Judge by stored values, replace verdicts and splits."""
    if not store.manifest.is_finished:
        raise InputError(f"{store.path}: the store is unfinished; run the command that wrote it again, then refilter")
    judge_store(store, recipe)
    write_run(store.path, {"refilter": asdict(recipe)})
    splits = write_splits(open_store(store.path))
    reasons = store.info()["reasons"]
    lines = [f"{store.path}: {reasons.get('kept', 0)} of {len(store)} patches kept"]
    lines += [f"  {count:6d}  {reason}" for reason, count in reasons.items()]
    lines += [f"  split {name}: {parts}" for name, parts in splits.items()]
    return Outcome("\n".join(lines), {"patches": len(store), "reasons": reasons, "splits": splits})


# What the command line parses; a class has no name of its own there but its action's.
Dataset = (
    Annotated[Info, subcommand("info")]
    | Annotated[Verify, subcommand("verify")]
    | Annotated[Refilter, subcommand("refilter")]
    | Annotated[Merge, subcommand("merge")]
    | Annotated[Split, subcommand("split")]
    | Annotated[Duplicates, subcommand("duplicates")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Card, subcommand("card")]
    | Annotated[DatasetReport, subcommand("report")]
)
