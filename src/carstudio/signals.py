"""Stop signals (Ctrl-C, SIGTERM) held back while something must not be cut in two."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def held_back_stops() -> Iterator[list[int]]:
    """Inside the block stop signals only enter the list that it is given; at its end they take effect.

    Blocking them in the kernel would not do: another thread takes the signal then, and Python interrupts the main
    thread for it. Off the main thread, which alone is interrupted, nothing is done.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    previous = {number: signal.signal(number, lambda number, frame: noted.append(number)) for number in STOP_SIGNALS}
    try:
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        if noted:
            signal.raise_signal(noted[0])
