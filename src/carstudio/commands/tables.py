"""Tables for people, as text."""

import io
import shutil
from collections.abc import Sequence

from rich import box
from rich.console import Console
from rich.table import Table


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows under a head, the last two columns wrapped to the terminal's width (90 to 140 columns)."""
    drawn = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for index, name in enumerate(head):
        drawn.add_column(name, overflow="fold", no_wrap=index < len(head) - 2)  # names are to be copied whole
    for row in rows:
        drawn.add_row(*row)
    width = min(max(shutil.get_terminal_size().columns, 90), 140)
    console = Console(file=io.StringIO(), width=width, markup=False, highlight=False, emoji=False)
    console.print(drawn)
    text = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO, given three lines above
    return "\n".join(line.rstrip() for line in text.splitlines())
