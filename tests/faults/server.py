"""Runs the program in forks of a process that has imported everything, for starting costs more than a small run.

Reads one JSON request per line, answers one JSON line. A fork is its own process group, calls `carstudio.cli.main` as
the console script does, and dies of real signals; nothing else is shared with the next one.
"""

import atexit
import errno
import json
import os
import resource
import signal
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ORPHANS_MAY_TAKE_S = 20.0
_POLL_S = 0.002


@dataclass(frozen=True, kw_only=True)
class Request:
    """One run of the program, and what shall happen to it."""

    arguments: list[str]
    log: str
    """File to which stdout and stderr are added (64 KiB at most)."""
    after_s: float | None = None
    """Send `signal` after this time."""
    at_operation: int | None = None
    """Send SIGKILL just before the n-th file operation (open for writing, rename, remove, mkdir), counted from 1."""
    full_at_operation: int | None = None
    """From the n-th file operation on the disk is full: opening for writing, mkdir and rename fail."""
    signal: int = signal.SIGKILL
    to_group: bool = True
    """To all its processes, as a terminal or a batch system does; else to the parent alone."""
    file_bytes: int | None = None
    """Largest file it may write (RLIMIT_FSIZE): beyond it writing fails, as on a full disk."""
    obeys_permissions: bool = False
    """For root, who may write everywhere: give that right up."""
    small_shards: bool = True
    """6 patches per shard instead of 1,024, so that small stores have several."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a run ended."""

    code: int
    """Exit code; minus the number of the signal that ended it."""
    seconds: float
    after_signal_s: float | None = None
    """From the signal to the end of the process."""
    orphans_s: float = 0.0
    """How much longer its worker processes lived."""
    operations: int = 0
    """File operations counted (only with `at_operation` or `full_at_operation`)."""


def serve() -> None:
    """Answer requests until stdin ends."""
    import torch._dynamo  # noqa: F401  # all imported once, before the forks; a torch optimiser asks for this one

    from carstudio.recipes import RECIPES
    from training.toy import TINY

    RECIPES["tiny"] = lambda: replace(TINY, steps=24, log_every=3, save_every=4)
    _adopt_orphans()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        print(json.dumps(asdict(run(Request(**json.loads(line))))), file=answers, flush=True)


def _adopt_orphans() -> None:
    """Orphans of our children become ours, so that they can be waited for (Linux; elsewhere init takes them)."""
    import ctypes

    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


def run(request: Request) -> Ended:
    """Fork, wait, signal, wait again."""
    reader, writer = os.pipe()  # a file would be subject to `file_bytes`
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _be_the_program(request, writer)
    os.close(writer)
    with suppress(OSError):
        os.setpgid(child, child)  # here as well as there: whoever is first
    signalled = None
    while (status := _poll(child)) is None:
        now = time.monotonic()
        if request.after_s is not None and signalled is None and now - started >= request.after_s:
            (os.killpg if request.to_group else os.kill)(child, request.signal)
            signalled = time.monotonic()
        time.sleep(_POLL_S)
    ended = time.monotonic()
    orphans_s = _wait_for_group(child)
    with open(request.log, "ab") as log, open(reader, "rb") as said:
        log.write(said.read())
    count = Path(f"{request.log}.count")
    return Ended(
        code=os.waitstatus_to_exitcode(status),
        seconds=ended - started,
        after_signal_s=None if signalled is None else ended - signalled,
        orphans_s=orphans_s,
        operations=int(count.read_text() or 0) if count.exists() else 0,
    )


def _poll(child: int) -> int | None:
    pid, status = os.waitpid(child, os.WNOHANG)
    return status if pid else None


def _wait_for_group(group: int) -> float:
    """Seconds until the last process of the group is gone; those that stay too long are killed and tell."""
    started = time.monotonic()
    while True:
        with suppress(ChildProcessError):
            os.waitpid(-group, os.WNOHANG)
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return time.monotonic() - started
        if time.monotonic() - started > ORPHANS_MAY_TAKE_S:
            os.killpg(group, signal.SIGKILL)
        time.sleep(_POLL_S)


def _be_the_program(request: Request, output: int) -> None:
    """In the fork: never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for target, source in ((0, nothing), (1, output), (2, output)):
            os.dup2(source, target)
        _apply(request)
        sys.argv = ["carstudio", *request.arguments]
        from carstudio.cli import main

        main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        threading._shutdown()  # type: ignore[attr-defined]  # as at the end of any program; os._exit skips both
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _apply(request: Request) -> None:
    import carstudio.dataset.writer as writer

    if request.small_shards:
        writer.ROWS_PER_GROUP = 3
        writer.StoreWriter.__init__.__kwdefaults__["groups_per_shard"] = 2
    if request.at_operation is not None or request.full_at_operation is not None:
        sys.addaudithook(_Operations(request))
    if request.file_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (request.file_bytes, request.file_bytes))
    if request.obeys_permissions and os.geteuid() == 0:
        _obey_permissions()


def _obey_permissions() -> None:
    """Drop CAP_DAC_OVERRIDE: root then needs the bits of a file's mode like everybody else (Linux)."""
    import ctypes

    libc = ctypes.CDLL("libc.so.6", use_errno=True)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3, this process
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable; then their upper halves
    if libc.capget(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    for index in (0, 1):
        sets[index] &= ~(1 << 1)
    if libc.capset(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capset")


class _Operations:
    """An audit hook that counts what changes files, and kills or fails at a given count; `LOG.count` holds it."""

    def __init__(self, request: Request) -> None:
        self._request, self._count = request, 0
        self._file = os.open(f"{request.log}.count", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if not writes and event not in ("os.rename", "os.remove", "os.mkdir", "os.truncate"):
            return
        self._count += 1
        os.pwrite(self._file, str(self._count).encode(), 0)
        if self._count == self._request.at_operation:
            (os.killpg if self._request.to_group else os.kill)(os.getpid(), self._request.signal)
        full_at = self._request.full_at_operation
        if full_at is not None and self._count >= full_at and event != "os.remove":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))


if __name__ == "__main__":
    serve()
