"""`carstudio dataset info|verify|refilter|export`: look into a store, judge it again, write it in another format."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.build import judge_store
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.legacy_json.exporter import export_legacy
from carstudio.dataset.runs import write_run
from carstudio.dataset.splits import write_splits
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Dataset(Output):
    """Look into a CarPatch3D store, judge it again, or write it in another format."""

    action: tyro.conf.Positional[Literal["info", "verify", "refilter", "export"]]
    """info: patches, cars, verdicts, splits. verify: checksums, pictures, boxes. refilter: judge every patch again by
    the thresholds and make the splits anew; no picture is read. export: the kept patches in another format."""
    store: tyro.conf.Positional[Path]
    """The store."""
    out: Path | None = None
    """export: a new or empty folder."""
    format: Literal["legacy-json"] = "legacy-json"
    """export: CarPatch3D as the authors published it; what came from their files is written as it was."""
    patches: Literal["kept", "all"] = "kept"
    """export: kept patches, or rejected ones too."""
    filters: tyro.conf.OmitArgPrefixes[FilterRecipe] = field(default_factory=FilterRecipe)
    """refilter: thresholds; the released ones by default."""

    def saved(self) -> str:
        """The pictures that an export has written."""
        return "nothing was written" if self.out is None else f"the pictures so far are saved in {self.out}"

    def run(self) -> Outcome:
        """Do what `action` says."""
        if self.action != "export" and (self.out is not None or self.patches != "kept"):
            raise InputError(f"--out and --patches are for export, not for {self.action}")
        if self.action != "refilter" and self.filters != FilterRecipe():
            raise InputError(f"thresholds are for refilter, not for {self.action}")
        store = open_store(self.store)
        if self.action == "info":
            info = store.info()
            return Outcome(json.dumps(info, indent=2), info)
        if self.action == "verify":
            return verify(store)
        return refilter(store, self.filters) if self.action == "refilter" else self._export(store)

    def _export(self, store: PatchStore) -> Outcome:
        if self.out is None:
            raise InputError("export needs --out FOLDER, a new or empty folder")
        with self.progress() as report:
            summary = export_legacy(store, self.out, patches=self.patches, report=report)
        lines = [f"{summary.out / name}: {count} patches" for name, count in summary.files.items()]
        lines += [f"  left out: {count:6d}  {reason}" for reason, count in summary.left_out.items()]
        return Outcome("\n".join(lines), plain(summary))


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
    write_run(store.path, {"refilter": asdict(recipe)})
    judge_store(store, recipe)
    splits = write_splits(open_store(store.path))
    reasons = store.info()["reasons"]
    lines = [f"{store.path}: {reasons.get('kept', 0)} of {len(store)} patches kept"]
    lines += [f"  {count:6d}  {reason}" for reason, count in reasons.items()]
    lines += [f"  split {name}: {parts}" for name, parts in splits.items()]
    return Outcome("\n".join(lines), {"patches": len(store), "reasons": reasons, "splits": splits})
