"""Work shared out to processes whose results come in order, and that never outlive the one who asked for it.

Workers do not hear Ctrl-C or a termination signal: the parent does, and ends them at once. Should the parent be
killed, they notice and end by themselves.
"""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import connection, resource_tracker
from typing import TypeVar

import cv2
import torch

from carstudio.errors import InputError
from carstudio.signals import STOP_SIGNALS, held_back_stops

Item = TypeVar("Item")
Result = TypeVar("Result")


def ordered_map(
    work: Callable[[Item], Result], items: Iterable[Item], *, workers: int, chunk: int = 1
) -> Generator[Result, None, None]:
    """`map(work, items)` on several processes, `chunk` items at a time; both `work` and its results get pickled.

    Items are taken as they are needed: they need not all be in memory.
    With one worker all is done in this process. Close the iterator (`contextlib.closing`) to end the workers at once.
    """
    if workers <= 1:
        yield from map(work, items)
        return
    left = iter(items)
    try:
        with _pool(workers) as pool:
            waiting: deque[Future[list[Result]]] = deque()
            while some := list(islice(left, chunk)):
                waiting.append(_submit(pool, work, some))
                if len(waiting) > 2 * workers:  # keeps memory bounded
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was ended from outside, for want of memory perhaps; the same command goes on from the "
            "shards that are saved, and fewer --workers need less memory"
        ) from error


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    context = multiprocessing.get_context("spawn")  # torch and onnxruntime have threads: forking them is not safe
    start_tracker()
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=begin_worker)
    try:
        yield pool
        pool.shutdown()
    except BaseException:
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()  # leaving the pool's own `with` block would wait for everything that was handed out
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def start_tracker() -> None:
    """Start what removes the semaphores of a process that ends without doing so itself, and tell it to keep quiet.

    It starts here because its start unblocks signals, which must not happen while a worker starts.
    """
    before = os.environ.get("PYTHONWARNINGS")
    quiet = "ignore::UserWarning:multiprocessing.resource_tracker"
    os.environ["PYTHONWARNINGS"] = f"{before},{quiet}" if before else quiet
    try:
        resource_tracker.ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before


def _submit(pool: ProcessPoolExecutor, work: Callable[[Item], Result], items: Sequence[Item]) -> Future[list[Result]]:
    """Hand out work; a worker that starts for it inherits that the stop signals are blocked.

    They are held back as well, so that no worker is started without the pool knowing of it.
    """
    with blocked_stops():
        return pool.submit(_run, work, items)


@contextmanager
def blocked_stops() -> Iterator[None]:
    """Processes started inside the block never hear stop signals; this one hears them at its end."""
    with held_back_stops():
        can_block = hasattr(signal, "pthread_sigmask")
        before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS) if can_block else set()
        try:
            yield
        finally:
            if can_block:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    return [work(item) for item in items]


def begin_worker() -> None:
    """One process per core, one thread per process; end with the parent."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "workers are started by multiprocessing"
    connection.wait([parent.sentinel])
    os._exit(1)
