"""Many inputs through a target in processes of their own, with bounds on memory and time; finds kept once per place.

Input number i of a seed is always the same, whatever the number of processes. A process writes the number of each
input down before it reads it, so that an input that ends the process (a crash in native code, a hang) is known.
"""

import faulthandler
import json
import mmap
import os
import random
import resource
import selectors
import shutil
import signal
import struct
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fuzz.edits import Edit, Files, draw_edits
from fuzz.target import Target, is_refused, make_input

MEMORY_BYTES = 2 * 2**30  # address space beyond what the process holds when it starts: room for one 120-megapixel photo
SECONDS = 20.0  # for one input; the slowest honest one takes about two
_PROGRESS = struct.Struct("<qqqd")  # the input being read; how many were read, how many refused; seconds of the slowest


class TooSlow(BaseException):
    """Raised in the reader by the alarm; no `Exception`, so that no reader swallows it."""


@dataclass(frozen=True)
class Find:
    """One input that was neither read nor refused. `signature` is the same for finds of one cause."""

    index: int
    signature: str
    trace: str


@dataclass
class Tally:
    """What a campaign came to."""

    target: str
    inputs: int = 0
    refused: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    peak_mib: int = 0
    finds: dict[str, list[Find]] = field(default_factory=dict)


def input_number(target: Target, seeds: Sequence[Files], seed: int, index: int) -> tuple[Files, list[Edit]]:
    """Input `index` of a campaign: a pure function of target, seed and index."""
    rng = random.Random(f"{target.name} {seed} {index}")
    first, other, edits = rng.randrange(len(seeds)), rng.randrange(len(seeds)), draw_edits(rng)
    return make_input(target, seeds, edits, first, other), edits


def attempt(target: Target, files: Files, folder: Path) -> tuple[bool, str, str]:
    """(was it refused, signature of the find or "", its trace)."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    signal.signal(signal.SIGALRM, _alarm)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        return is_refused(target, files, folder), "", ""
    except (Exception, TooSlow) as error:
        signal.setitimer(signal.ITIMER_REAL, 0)
        return False, signature_of(error), "".join(traceback.format_exception(error))[-6000:]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _alarm(number: int, frame: object) -> None:
    raise TooSlow


def signature_of(error: BaseException) -> str:
    """Kind of the exception and the place in our sources (else in the target) where it passed."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
    ours = [frame for frame in frames if "/carstudio/" in frame.filename] or frames
    last = ours[-1]
    return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}"


def run_campaign(
    target: Target, *, inputs: int, seed: int, jobs: int, report: Callable[[int], None] = lambda done: None
) -> Tally:
    """All inputs of a target, shared out to `jobs` processes."""
    tally, started = Tally(target.name), time.monotonic()
    seeds = target.seeds()
    with tempfile.TemporaryDirectory(prefix="carstudio-fuzz-") as work:
        shares = [_Share(target, seeds, seed, range(job, inputs, jobs), Path(work) / str(job)) for job in range(jobs)]
        for find in _watch(shares, report):
            tally.finds.setdefault(find.signature, []).append(find)
    tally.inputs = sum(share.tested for share in shares)
    tally.refused = sum(share.refused for share in shares)
    tally.slowest_s = max((share.slowest_s for share in shares), default=0.0)
    tally.seconds = time.monotonic() - started
    tally.peak_mib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024
    return tally


class _Share:
    """One process' part of the inputs; started again after the input that ended it."""

    def __init__(self, target: Target, seeds: Sequence[Files], seed: int, indices: range, work: Path) -> None:
        self.target, self.seeds, self.seed, self.indices, self.work = target, seeds, seed, indices, work
        self.tested, self.refused, self.slowest_s = 0, 0, 0.0
        self._memory = mmap.mmap(-1, _PROGRESS.size)
        self.start()

    def start(self) -> None:
        """Fork a reader of the inputs that are left."""
        self._base = (self.tested, self.refused)
        _PROGRESS.pack_into(self._memory, 0, -1, 0, 0, self.slowest_s)
        reading, writing = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(reading)
            self._read_all(writing)
        os.close(writing)
        self.pipe, self._buffer = reading, b""
        self._last_seen, self._since = -2, time.monotonic()

    def _read_all(self, pipe: int) -> None:
        code = 1
        faulthandler.disable()  # pytest's: a crash is told by the parent
        try:
            _bound_memory()
            self._loop(pipe)
            code = 0
        finally:
            os._exit(code)

    def _loop(self, pipe: int) -> None:
        tested, refused, slowest = 0, 0, self.slowest_s
        for index in self.indices:
            _PROGRESS.pack_into(self._memory, 0, index, tested, refused, slowest)
            files, _ = input_number(self.target, self.seeds, self.seed, index)
            start = time.monotonic()
            is_no, signature, trace = attempt(self.target, files, self.work)
            tested, refused, slowest = tested + 1, refused + is_no, max(slowest, time.monotonic() - start)
            if signature:
                os.write(pipe, json.dumps([index, signature, trace]).encode() + b"\n")
        _PROGRESS.pack_into(self._memory, 0, -1, tested, refused, slowest)

    def finds(self) -> Iterator[Find]:
        """What the reader wrote since the last call."""
        self._buffer += os.read(self.pipe, 1 << 20)
        *lines, self._buffer = self._buffer.split(b"\n")
        for line in lines:
            yield Find(*json.loads(line))

    def look(self) -> None:
        """Take over the counters; kill a reader that hangs in native code, where no alarm is heard."""
        index, tested, refused, self.slowest_s = _PROGRESS.unpack_from(self._memory, 0)
        self.tested, self.refused = self._base[0] + tested, self._base[1] + refused
        if index != self._last_seen:
            self._last_seen, self._since = index, time.monotonic()
        elif index >= 0 and time.monotonic() - self._since > 2 * SECONDS:
            os.kill(self.pid, signal.SIGKILL)

    def end(self) -> Find | None:
        """Wait for the reader; the input that ended it, if one did, is left out when it starts again."""
        os.close(self.pipe)
        _, status = os.waitpid(self.pid, 0)
        self.look()
        index = self._last_seen
        if index < 0:
            return None
        cause = f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"exit {os.WEXITSTATUS(status)}"
        self.tested += 1
        self.indices = range(index + self.indices.step, self.indices.stop, self.indices.step)
        return Find(index, f"process ended by {cause}", f"the process that read the input ended by {cause}")


def _watch(shares: Sequence[_Share], report: Callable[[int], None]) -> Iterator[Find]:
    with selectors.DefaultSelector() as selector:
        for share in shares:
            selector.register(share.pipe, selectors.EVENT_READ, share)
        while selector.get_map():
            for key, _ in selector.select(timeout=1.0):
                share, before = key.data, len(key.data._buffer)
                found = list(share.finds())
                yield from found
                if found or len(share._buffer) > before:
                    continue
                selector.unregister(share.pipe)  # nothing came: the pipe's other end is closed
                find = share.end()
                if find is not None:
                    yield find
                    share.start()
                    selector.register(share.pipe, selectors.EVENT_READ, share)
            for share in shares:
                if share.pipe in selector.get_map():
                    share.look()
            report(sum(share.tested for share in shares))


def _bound_memory() -> None:
    """An input that asks for too much gets a MemoryError, which is a find."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + MEMORY_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
