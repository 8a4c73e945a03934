"""What every verb shares: the options `--json` and `--quiet`, and what it hands back to be printed."""

import dataclasses
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carstudio import __version__
from carstudio.progress import Report, RichProgress, silent


@dataclass(frozen=True)
class Outcome:
    """What a verb did: text for people, a JSON value for programs."""

    text: str
    value: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Output:
    """Base of every verb: the options they share."""

    json: bool = False
    """Print a machine-readable result."""
    quiet: bool = False
    """No progress bars."""

    def run(self) -> Outcome:
        """Do the work of the verb."""
        raise NotImplementedError

    def saved(self) -> str:
        """What is on disk when the verb was stopped in the middle, in a few words. Imports nothing: it is urgent."""
        return "nothing was written"

    def again(self, arguments: list[str]) -> list[str]:
        """The command line that goes on where `arguments` were stopped, verb included."""
        return arguments

    @contextmanager
    def progress(self) -> Iterator[Report]:
        """Bars on a terminal, silence with --quiet, --json or when the output is no terminal."""
        if self.quiet or self.json or not sys.stdout.isatty():
            yield silent
            return
        with RichProgress() as bars:
            yield bars


def split_of(text: str | None) -> str | None:
    """A split's name; `none` in any case, as all verbs write it, is no split."""
    return None if text is None or text.lower() == "none" else text


def plain(value: Any) -> Any:
    """Dataclasses and paths as JSON values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def provenance() -> dict[str, Any]:
    """The command line and version to write beside an output."""
    return {"command": shlex.join(["carstudio", *sys.argv[1:]]), "carstudio": __version__}
