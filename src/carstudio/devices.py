"""Which device networks run on, and on how many threads."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from carstudio.errors import InputError


def pick_device(name: str) -> torch.device:
    """Pick a device: "auto" is CUDA, else Apple's MPS, else the CPU; anything else as torch names it."""
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise InputError(
            f"device {name!r} cannot be used here ({str(error).splitlines()[0]}); try --device cpu"
        ) from error
    return device


@contextmanager
def one_thread() -> Iterator[None]:
    """Operations on one thread each, as in a worker process."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
