"""Stop signals: Ctrl-C and SIGTERM end any verb within a second, whatever it is doing.

While modules are imported the process just leaves: nothing is begun, and some libraries swallow what is raised then.
Later the main thread raises `Interrupted` at its next line of Python. Where it is deep in a matrix product or a
library, a watching thread, which the signal wakes through a pipe, says goodbye and ends the process when the grace is
over. That is no worse than a kill: files are whole or absent, and what was begun goes on with the command named.
"""

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType

from carstudio.errors import Interrupted
from carstudio.signals import STOP_SIGNALS

GRACE_S = 0.6  # for unwinding, or saving at a step's end; the rest of the second: a goodbye, freeing gigabytes
_SPEAKING_S = 0.2  # for the main thread, when it has begun to say goodbye
_SHOW_CURSOR = "\x1b[?25h"  # progress bars hide it


class StopWatch:
    """Turns stop signals into `Interrupted`, and ends the process when that is not heard in time.

    `farewell()` is what to say when the process must be ended; set it once it is known what runs. A second signal ends
    the process at once. `stopped_by` is the signal that was raised.
    """

    def __init__(self) -> None:
        self.farewell: Callable[[], str] = lambda: "interrupted; nothing was written"
        self.stopped_by: int | None = None
        self._reader = -1
        self._is_started = False
        self._mouth = threading.Lock()  # taken by the first who speaks, never given back
        self._has_spoken = threading.Event()

    def start(self) -> None:
        """Watch from now on, in the main thread; a signal ends the process at once until `raise_stops` is called."""
        self._reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in STOP_SIGNALS:
            signal.signal(number, lambda number, frame: self._end(number))
        self._is_started = True
        threading.Thread(target=self._watch, daemon=True).start()

    def raise_stops(self) -> None:
        """From now on a signal raises `Interrupted`: something is begun that must be tidied up."""
        if self._is_started:
            for number in STOP_SIGNALS:
                signal.signal(number, self._raise)

    def _raise(self, number: int, frame: FrameType | None) -> None:
        for other in STOP_SIGNALS:
            signal.signal(other, _ignore)  # tidying up is not to be interrupted; the watch hears a second signal
        self.stopped_by = number
        raise Interrupted(number)

    def say_goodbye(self, write: Callable[[str], object]) -> None:
        """Hand the last words to `write`, if they were not said yet."""
        if self._mouth.acquire(blocking=False):
            write(self.farewell())
            self._has_spoken.set()

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
            self.say_goodbye(_write_at_once)
            self._has_spoken.wait(_SPEAKING_S)
        finally:
            os._exit(128 + number)


def _write_at_once(text: str) -> None:
    """Past the buffers, which the main thread may hold."""
    os.write(2, f"{text}{_SHOW_CURSOR if os.isatty(2) else ''}\n".encode())


def _ignore(number: int, frame: FrameType | None) -> None:
    """A handler of ours rather than SIG_IGN: only those wake the watch."""
