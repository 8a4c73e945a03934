"""Several processes that train one model: each takes its share of a step's patches, the gradients are averaged.

A step sees the same patches and pixels however many share it, and gradients are weighted by the rays they stand on: the
number of processes changes the order of sums only (and what batch norm sees). The first process alone writes.

On a CPU one thread per process beats threads within operations by far: what a step is made of is small. `team_of`
starts such processes; started by `torchrun`, a process finds its team in the environment, one GPU for each.
"""

import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from carstudio.dataset.workers import begin_worker, blocked_stops, start_tracker
from carstudio.devices import one_thread
from carstudio.errors import InputError

_LOOPBACK = {"linux": "lo", "darwin": "lo0"}  # gloo would listen where the host's name points to
_LAST_WORDS_S = 5.0  # that a killed process may take to be gone


@dataclass(frozen=True)
class Team:
    """This process's place among those that train together; alone by default."""

    rank: int = 0
    size: int = 1
    complaints: tuple[Connection, ...] = ()  # what the other processes may have to say, heard by the first

    @property
    def is_first(self) -> bool:
        """Whether this process writes logs and checkpoints."""
        return self.rank == 0

    def share(self, count: int) -> range:
        """Which of `count` patches this process takes: every `size`-th."""
        return range(self.rank, count, self.size)

    def average(
        self,
        parameters: Sequence[Tensor],
        *,
        weight: float,
        means: Sequence[float],
        from_first: Sequence[float],
        sums: Sequence[float] = (),
    ) -> tuple[list[float], list[float], list[float]]:
        """Replace gradients by their mean over the team, weighted; returns means of other numbers, weighted as well,
        the first's own numbers, and sums.

        `InputError` when another process has ended.
        """
        if self.size == 1:
            return list(means), list(from_first), list(sums)
        said = [value if self.is_first else 0.0 for value in from_first]
        numbers = torch.tensor([weight, *(weight * value for value in means), *said, *sums], dtype=torch.float32)
        with_gradient = [p for p in parameters if p.grad is not None]
        gradients = [p.grad for p in with_gradient if p.grad is not None]
        flat = torch.cat([numbers.to(parameters[0].device), *(g.flatten() for g in gradients)])
        rest = flat[len(numbers) :].mul_(weight)
        self._sum(flat)
        numbers = flat[: len(numbers)].cpu()
        rest.div_(flat[0].clamp(min=1e-8))
        for parameter, part in zip(with_gradient, rest.split([g.numel() for g in gradients]), strict=True):
            parameter.grad = part.view_as(parameter)
        total = max(float(numbers[0]), 1e-8)
        averaged, told, summed = numbers[1:].split([len(means), len(from_first), len(sums)])
        return [float(value) / total for value in averaged], told.tolist(), summed.tolist()

    def _sum(self, flat: Tensor) -> None:
        try:
            dist.all_reduce(flat)
        except RuntimeError as error:
            raise InputError(self._complaint()) from error

    def _complaint(self) -> str:
        for complaint in self.complaints:
            with suppress(EOFError):  # it ended without a word
                if complaint.poll(0.5):
                    return str(complaint.recv())
        return (
            "a process of this training was ended from outside, for want of memory perhaps; the same command with "
            "--resume goes on from the last checkpoint, and fewer --processes need less memory"
        )

    def wait(self) -> None:
        """Until all are here."""
        if self.size > 1:
            dist.barrier()


def usable_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_torchrun() -> bool:
    """Whether torchrun started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


def is_first_process() -> bool:
    """Whether this process is the one of torchrun's that speaks (always, without torchrun)."""
    return not is_torchrun() or os.environ["RANK"] == "0"


def good_number_of_processes(device: torch.device, *, most: int = 4) -> int:
    """One per core on a CPU, within reason; one elsewhere."""
    return min(most, usable_cores()) if device.type == "cpu" else 1


def torchrun_device(device: torch.device) -> torch.device:
    """The GPU that belongs to this process of torchrun's; other devices stay as they are."""
    if is_torchrun() and device.type == "cuda" and device.index is None:
        return torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    return device


@contextmanager
def team_of(processes: int, device: torch.device, work: Callable[[Team], Any]) -> Iterator[Team]:
    """This process as the first of a team of so many, or as what torchrun says; the others do `work(team)`.

    `work` is pickled. The others end with the block, or with this process however it ends.
    """
    if is_torchrun():
        if processes > 1:
            raise InputError("--processes and torchrun cannot go together; leave out --processes")
        with _group(device, int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]), "env://"):
            yield Team(dist.get_rank(), dist.get_world_size())
        return
    if processes <= 1:
        yield Team()
        return
    if device.type != "cpu":
        raise InputError(
            f"--processes is for CPUs, found device {device}; for several GPUs: torchrun --nproc-per-node N -m "
            "carstudio train ..."
        )
    with one_thread(), tempfile.TemporaryDirectory() as folder, _others(processes, Path(folder), work) as complaints:
        with _group(device, 0, processes, (Path(folder) / "meeting").as_uri()):
            yield Team(0, processes, complaints)


@contextmanager
def _group(device: torch.device, rank: int, size: int, method: str) -> Iterator[None]:
    if device.type == "cuda":
        torch.cuda.set_device(device)
    elif sys.platform in _LOOPBACK and method != "env://":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", _LOOPBACK[sys.platform])
    backend = "nccl" if device.type == "cuda" else "gloo"
    dist.init_process_group(backend, init_method=method, rank=rank, world_size=size)
    try:
        yield
    finally:
        dist.destroy_process_group()


@contextmanager
def _others(size: int, folder: Path, work: Callable[[Team], Any]) -> Iterator[tuple[Connection, ...]]:
    context = multiprocessing.get_context("spawn")
    start_tracker()
    started, complaints = [], []
    try:
        with blocked_stops():
            for rank in range(1, size):
                ours, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_follow, args=(rank, size, folder, work, theirs), daemon=True)
                process.start()
                theirs.close()
                started.append(process)
                complaints.append(ours)
        yield tuple(complaints)
        for process in started:
            process.join()
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.join(_LAST_WORDS_S)


def _follow(rank: int, size: int, folder: Path, work: Callable[[Team], Any], complaint: Connection) -> None:
    """What another process does; the first hears why it could not go on."""
    begin_worker()
    try:
        with _group(torch.device("cpu"), rank, size, (folder / "meeting").as_uri()):
            work(Team(rank, size))
    except BaseException as error:
        complaint.send(str(error))
        os._exit(1)
