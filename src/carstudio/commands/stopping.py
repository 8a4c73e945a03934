"""Stop signals: Ctrl-C and SIGTERM end any verb within a second, whatever it is doing.

The main thread raises `Interrupted` at its next line of Python. Where it is deep in a matrix product or a library, a
watching thread, which the signal wakes through a pipe, says goodbye and ends the process when the grace is over. That
is no worse than a kill: files are whole or absent, and what was begun goes on with the command that is named.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from carstudio.errors import Interrupted

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
GRACE_S = 0.75  # for unwinding, or for saving at a step's end; the rest of the second is for the goodbye
_SHOW_CURSOR = "\x1b[?25h"  # progress bars hide it


class StopWatch:
    """Turns stop signals into `Interrupted`, and ends the process when that is not heard in time.

    `farewell()` is what to say when the process must be ended; set it once it is known what runs. A second signal ends
    the process at once.
    """

    def __init__(self) -> None:
        self.farewell: Callable[[], str] = lambda: "interrupted; nothing was written"
        self._reader = -1
        self._mouth = threading.Lock()  # taken by the first who speaks, never given back

    def start(self) -> None:
        """Watch from now on; call it in the main thread."""
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in STOP_SIGNALS:
            signal.signal(number, _raise_interrupted)
        threading.Thread(target=self._watch, daemon=True).start()

    def say(self, text: str) -> None:
        """Write a last message to stderr, unless one was written already."""
        if self._mouth.acquire(blocking=False):
            print(text, file=sys.stderr, flush=True)

    def _watch(self) -> None:
        number = 0
        while number not in STOP_SIGNALS:
            number = os.read(self._reader, 1)[0]
        threading.Thread(target=self._watch_again, args=(number,), daemon=True).start()
        # Not `sleep`: the main thread may be done earlier, and then the process ends without us.
        threading.Event().wait(GRACE_S)
        self._end(number)

    def _watch_again(self, number: int) -> None:
        os.read(self._reader, 1)
        self._end(number)

    def _end(self, number: int) -> None:
        try:
            if self._mouth.acquire(blocking=False):
                text = self.farewell() + (_SHOW_CURSOR if os.isatty(2) else "")
                os.write(2, f"{text}\n".encode())  # past the buffers: the main thread may hold them
        finally:
            os._exit(128 + number)


def _raise_interrupted(number: int, frame: FrameType | None) -> None:
    for other in STOP_SIGNALS:
        signal.signal(other, _ignore)  # tidying up is not to be interrupted; the watch hears a second signal
    raise Interrupted(number)


def _ignore(number: int, frame: FrameType | None) -> None:
    """A handler of ours rather than SIG_IGN: only those wake the watch."""


@contextmanager
def noted_stops() -> Iterator[Callable[[], bool]]:
    """Inside the block a stop signal is noted instead of raised; the block asks and ends at a place it chooses.

    Raises `Interrupted` at the end of the block when there was one. Only the main thread can do this; elsewhere the
    answer is always no.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    previous = {number: signal.signal(number, lambda number, frame: noted.append(number)) for number in STOP_SIGNALS}
    try:
        yield lambda: bool(noted)
    except Interrupted:
        if not noted:
            raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, _ignore if noted and handler is _raise_interrupted else handler)
    if noted:
        raise Interrupted(noted[0])
