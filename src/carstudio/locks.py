"""One writer per folder: a lock of the kernel's, freed with its process, however that ends.

The lock is `flock` on the file `.lock` in the folder, which also says who holds it. A leftover `.lock` of a killed
process locks nothing. Where the system has no `flock` (Windows) or the file system refuses it (some network mounts)
nothing is locked: there, do not start two writers on one folder. Readers never ask.
"""

import os
import socket
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO

from carstudio.errors import InputError, StorageError
from carstudio.files import make_folder, remove_partials

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]  # tested before every use

LOCK_NAME = ".lock"


class FolderLock:
    """The right to write below `folder`, from construction to `release()` or the end of the `with` block.

    Makes the folder when it is missing. `InputError` names the folder and the process that is writing there.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        self._path = self.folder / LOCK_NAME
        self._file: IO[bytes] | None = None
        try:
            make_folder(self.folder)
            self._acquire()
        except OSError as error:
            raise StorageError(self.folder, error.strerror or error) from error

    @property
    def is_held(self) -> bool:
        """Whether `release` has not been called yet."""
        return self._file is not None

    def _acquire(self) -> None:
        while self._file is None:
            file = os.fdopen(os.open(self._path, os.O_RDWR | os.O_CREAT, 0o644), "r+b", buffering=0)
            if not _lock(file):
                holder = file.read(200).decode(errors="replace").strip()
                file.close()
                raise InputError(
                    f"{self.folder}: {holder or 'another process'} is writing here; wait for it, stop it, "
                    "or choose another folder"
                )
            if _is_at(self._path, file):
                self._file = file
            else:  # its last holder removed it between our opening and our locking
                file.close()
        with suppress(OSError):  # on a full disk only our name is missing: the lock stands
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def release(self) -> None:
        """Let others write; twice is once."""
        if self._file is not None:
            with suppress(OSError):
                self._path.unlink()  # before the lock goes: nobody else can hold it yet
            self._file.close()
            self._file = None

    def __enter__(self) -> "FolderLock":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def clear_leftovers(folder: Path | str) -> None:
    """Remove what a killed writer left in a folder that is whole, unless somebody is writing or nobody may."""
    with suppress(InputError), FolderLock(folder):
        remove_partials(folder)


def _lock(file: IO[bytes]) -> bool:
    """Take the kernel's lock without waiting; True as well where there are no such locks."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: go on alone
        return True
    return True


def _is_at(path: Path, file: IO[bytes]) -> bool:
    try:
        there, ours = path.stat(), os.fstat(file.fileno())
    except FileNotFoundError:
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
