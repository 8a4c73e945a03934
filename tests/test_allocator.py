"""The allocator's setting: freed memory stays mapped, and nothing happens where the C library is another one."""

import ctypes
import subprocess
import sys

import pytest

from carstudio import allocator

# Frees and takes 256 MiB again and again; fresh pages are counted by the kernel as minor faults (4 KiB each).
FAULTS = """
import resource, sys
import numpy as np
from carstudio.allocator import keep_freed_memory
if sys.argv[1] == "keep":
    assert keep_freed_memory() is True
np.ones(2**25)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    np.ones(2**25)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def has_glibc() -> bool:
    try:
        return hasattr(ctypes.CDLL("libc.so.6"), "gnu_get_libc_version")
    except OSError:
        return False


@pytest.mark.skipif(not has_glibc(), reason="the C library is not glibc: there is nothing to set")
def test_a_large_array_takes_the_pages_of_the_last_one() -> None:
    """Counted by the kernel in a process of its own: without the setting every array is mapped afresh."""
    faults = {}
    for mode in ("keep", "leave"):
        command = [sys.executable, "-c", FAULTS, mode]
        faults[mode] = int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    assert faults["keep"] < 100  # five arrays of 65,536 small pages, or 128 huge ones each
    assert faults["leave"] > 5 * 100


def test_another_system_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: pytest.fail("no C library is to be opened"))
    assert allocator.keep_freed_memory() is False


def test_another_c_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Alpine: no libc.so.6, or one without mallopt."""
    monkeypatch.setattr(sys, "platform", "linux")

    def missing(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(ctypes, "CDLL", missing)
    assert allocator.keep_freed_memory() is False
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert allocator.keep_freed_memory() is False


def test_a_refused_threshold_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """mallopt answers 0 when it does not take a value."""
    monkeypatch.setattr(sys, "platform", "linux")
    asked: list[tuple[int, int]] = []

    class Library:
        def mallopt(self, name: int, value: int) -> int:
            asked.append((name, value))
            return 0 if name == -1 else 1

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Library())
    assert allocator.keep_freed_memory() is False
    assert [name for name, _ in asked] == [-3, -1]
