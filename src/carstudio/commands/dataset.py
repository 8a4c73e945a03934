"""`carstudio dataset info|verify`: look into a store."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from carstudio.commands.command import Outcome, Output
from carstudio.dataset.store import open_store
from carstudio.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Dataset(Output):
    """Look into a CarPatch3D store: `info` counts, `verify` reads everything and checks it."""

    action: tyro.conf.Positional[Literal["info", "verify"]]
    """info: patches, cars, verdicts, splits. verify: checksums, pictures, boxes."""
    store: tyro.conf.Positional[Path]
    """The store."""

    def run(self) -> Outcome:
        """Count, or check; a store with problems is an `InputError` that lists them."""
        store = open_store(self.store)
        if self.action == "info":
            info = store.info()
            return Outcome(json.dumps(info, indent=2), info)
        problems = store.verify()
        if problems:
            raise InputError(f"{self.store}: {len(problems)} problems\n" + "\n".join(problems))
        return Outcome(f"{self.store}: {len(store)} patches, all sound", {"patches": len(store), "problems": []})
