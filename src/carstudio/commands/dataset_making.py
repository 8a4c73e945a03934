"""`carstudio dataset merge|split|duplicates`: one store of several, a split of one's own, pictures that repeat."""

import os
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from carstudio.commands.build import describe_unfinished
from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.duplicates import find_duplicates
from carstudio.dataset.fingerprints import Likeness
from carstudio.dataset.measured import azimuths_deg, measure
from carstudio.dataset.merge import merge_stores
from carstudio.dataset.runs import write_run
from carstudio.dataset.splits import SplitBy, count_parts, kept_views, make_split, seen_from, write_splits
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.locks import FolderLock


@dataclass(frozen=True, kw_only=True)
class Merge(Output):
    """Make one store of several; patches that two of them have with equal rows are taken once."""

    stores: tyro.conf.Positional[tuple[Path, ...]]
    """Two stores or more."""
    out: Path
    """The store to write."""

    def saved(self) -> str:
        """The whole shards."""
        return describe_unfinished(self.out)

    def run(self) -> Outcome:
        """Merge and count."""
        with self.progress() as report:
            summary = merge_stores(self.stores, self.out, report=report)
        lines = [
            f"{summary.out}: {summary.patches} patches of {len(self.stores)} stores, {summary.kept} kept; "
            f"{summary.repeated} were there twice with equal rows",
            *(f"  split {name}: {parts}" for name, parts in summary.splits.items()),
        ]
        return Outcome("\n".join(lines), plain(summary))


@dataclass(frozen=True, kw_only=True)
class Split(Output):
    """Write a split of one's own over the kept patches; pictures that repeat each other stay on one side."""

    store: tyro.conf.Positional[Path]
    """The store."""
    name: str
    """The split's name: `splits/NAME.parquet`."""
    by: SplitBy
    """What is never parted: a car (instance), a sequence, a patch; view: each car's last views in time are tested; yaw:
    its views from farthest around from the first one."""
    test_share: float = 0.1
    """Share of the cars, sequences, patches, or of each car's views that is tested."""
    seed: int = 0
    """Another seed, another draw. By view or yaw nothing is drawn."""
    force: bool = False
    """Replace a split of this name."""

    def run(self) -> Outcome:
        """Draw and write."""
        with FolderLock(require_store(self.store)) as lock:
            store = open_store(self.store, lock=lock)
            if self.name in store.split_names() and not self.force:
                raise InputError(
                    f"{self.store}: has a split {self.name!r} already; choose another --name, or --force to replace it"
                )
            views = kept_views(store)
            if self.by == "yaw":
                views = seen_from(views, azimuths_deg(measure(store)))
            parts = make_split(views, by=self.by, test_share=self.test_share, seed=self.seed)
            store.write_split(self.name, parts)
            settings = {"by": self.by, "test_share": self.test_share, "seed": self.seed}
            write_run(self.store, {"split": {"name": self.name, **settings}})
        counts = count_parts(parts)
        return Outcome(f"split {self.name}: {counts}", {"split": self.name, "parts": counts})


@dataclass(frozen=True, kw_only=True)
class Duplicates(Output):
    """Find pictures that are the same, byte for byte or nearly, and make the standard splits anew around them."""

    store: tyro.conf.Positional[Path]
    """The store; gets `duplicates.parquet`. `refilter --drop-duplicates` then drops all but the first of each."""
    likeness: tyro.conf.OmitArgPrefixes[Likeness] = field(default_factory=Likeness)
    """What counts as nearly the same."""
    workers: int = 0
    """Processes; 0: one per core. Changes nothing in the result."""

    def run(self) -> Outcome:
        """Look at every picture; write the groups and the splits."""
        if self.workers < 0:
            raise InputError(f"--workers must be 0 (one per core) or more, found {self.workers}")
        with FolderLock(require_store(self.store)) as lock, self.progress() as report:
            store = open_store(self.store, lock=lock)
            workers = min(
                self.workers or os.cpu_count() or 1, 1 + len(store) // 2000
            )  # a process takes seconds to start
            found = find_duplicates(store, self.likeness, workers=workers, report=report)
            write_run(self.store, {"duplicates": plain(self.likeness)})
            splits = write_splits(open_store(self.store, lock=lock))
        counts = found.counts()
        lines = [
            f"{self.store}: {counts['groups']} groups of like pictures; {counts['exact']} patches are the same as "
            f"another byte for byte, {counts['near']} nearly; {counts['repeating']} repeat an earlier one",
            *(f"  split {name}: {parts}" for name, parts in splits.items()),
        ]
        return Outcome("\n".join(lines), counts | {"splits": splits})


def require_store(path: Path) -> Path:
    """`path`, if there is a finished store: a lock must not make a folder of a misspelt name."""
    if not open_store(path).manifest.is_finished:
        raise InputError(f"{path}: the store is unfinished; run the command that wrote it again first")
    return path
