"""How long work tells where it is: a function that library code calls and the command line draws with rich."""

from collections.abc import Callable
from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

# report(description, done, total, note): called as often as the work likes; `note` is a short figure ("PSNR 21.3").
Report = Callable[[str, int, int, str], None]


def silent(description: str, done: int, total: int, note: str = "") -> None:
    """The default: say nothing."""


class RichProgress:
    """A `Report` that draws one bar per description; a context manager that clears up after itself."""

    def __init__(self) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
        )
        self._progress = Progress(*columns, refresh_per_second=4)
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> "RichProgress":
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, description: str, done: int, total: int, note: str = "") -> None:
        """Draw the bar of `description` at `done` of `total`."""
        if description not in self._tasks:
            self._tasks[description] = self._progress.add_task(description, total=total, note="")
        self._progress.update(self._tasks[description], completed=done, total=total, note=note)
