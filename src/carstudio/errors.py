"""The exceptions that are not our bugs: the user's input, the user's disk, the user's Ctrl-C.

The command line turns the first two into exit code 2 and a single message, the third into 130 or 143; everything else
is exit code 1.
"""

import signal
from pathlib import Path


class InputError(ValueError):
    """Something the user or a file gave is wrong; the message says what, where, expected, found and the way out."""


class StorageError(InputError):
    """A file cannot be written: the disk is full, the folder read-only, the quota used up."""

    def __init__(self, path: Path | str, reason: object) -> None:
        super().__init__(
            f"{path}: cannot be written ({reason}); make room or permit writing there, or choose another place"
        )


class Interrupted(KeyboardInterrupt):
    """A signal asked us to stop; `signal` is its number. Not an `Exception`, so that nothing swallows it."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.signal = number


def first_line(error: Exception, most: int = 200) -> str:
    """What a library says of its own error, in one line of at most so many characters."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:most]


def shortened(value: object, most: int = 90) -> str:
    """A value as it was found, for a message."""
    text = repr(value)
    return text if len(text) <= most else f"{text[: most - 3]}..."
