"""The C library's thresholds: what they change in this process's memory, and machines where there are none."""

import ctypes
import subprocess
import sys
from types import SimpleNamespace

import pytest

from carstudio import allocator
from carstudio.allocator import keep_freed_memory

IS_GLIBC = sys.platform.startswith("linux") and hasattr(ctypes.CDLL(None), "gnu_get_libc_version")

# Pages touched for the first time while 64 MiB are allocated, written and freed eight times over.
FAULTS = """
import ctypes, resource, sys
if sys.argv[1] == "keep":
    from carstudio.allocator import keep_freed_memory
    assert keep_freed_memory()
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
libc.free.argtypes = [ctypes.c_void_p]
start = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(8):
    block = libc.malloc(64 * 2**20)
    ctypes.memset(block, 1, 64 * 2**20)
    libc.free(block)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - start)
"""


def faults(mode: str) -> int:
    ended = subprocess.run([sys.executable, "-c", FAULTS, mode], capture_output=True, text=True, check=True)
    return int(ended.stdout)


@pytest.mark.skipif(not IS_GLIBC, reason="the C library here is not glibc; nothing is changed")
def test_freed_memory_is_used_again_instead_of_being_mapped_afresh() -> None:
    """Seven of the eight rounds cost no new page; without it all eight do (whatever the size of a page is)."""
    assert faults("keep") < faults("plain") / 4


@pytest.mark.skipif(not IS_GLIBC, reason="the C library here is not glibc; nothing is changed")
def test_it_says_yes_on_glibc() -> None:
    assert keep_freed_memory()


def test_other_systems_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(name: str) -> None:
        raise AssertionError("no library may be opened")

    monkeypatch.setattr(allocator.sys, "platform", "darwin")
    monkeypatch.setattr(allocator.ctypes, "CDLL", never)
    assert not keep_freed_memory()


@pytest.mark.parametrize("library", ["none", "without mallopt", "refuses both", "refuses the second"])
def test_a_c_library_that_cannot_do_it_is_no_error(monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    asked: list[tuple[int, int]] = []

    def mallopt(name: int, value: int) -> int:
        asked.append((name, value))
        return int(library == "refuses the second" and len(asked) == 1)

    def open_library(name: str) -> SimpleNamespace:
        if library == "none":
            raise OSError(f"{name}: cannot open shared object file")
        return SimpleNamespace() if library == "without mallopt" else SimpleNamespace(mallopt=mallopt)

    monkeypatch.setattr(allocator.sys, "platform", "linux")
    monkeypatch.setattr(allocator.ctypes, "CDLL", open_library)
    assert keep_freed_memory() is False
    assert all(0 < value < 2**31 for _, value in asked)  # mallopt takes a C int


def test_what_is_asked_of_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """M_MMAP_THRESHOLD is -3 and M_TRIM_THRESHOLD is -1 in glibc's malloc.h."""
    asked: dict[int, int] = {}
    monkeypatch.setattr(allocator.sys, "platform", "linux")
    fake = SimpleNamespace(mallopt=lambda name, value: asked.setdefault(name, value) and 1)
    monkeypatch.setattr(allocator.ctypes, "CDLL", lambda name: fake)
    assert keep_freed_memory()
    assert set(asked) == {-3, -1}
