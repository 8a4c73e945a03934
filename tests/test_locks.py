"""One writer per folder: who is second is told who is first, and a killed holder holds nothing."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import carstudio.locks
from carstudio.dataset.store import StoreWriter, open_store
from carstudio.dataset.verdicts import Verdict
from carstudio.errors import InputError, StorageError
from carstudio.locks import LOCK_NAME, FolderLock
from carstudio.training.trainer import train
from training.toy import TINY, toy_record, toy_store

HOLD = """
import sys
from carstudio.locks import FolderLock
with FolderLock(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


def hold(folder: Path) -> subprocess.Popen[str]:
    """Another process that holds the folder until its stdin ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_the_second_is_told_folder_and_process_of_the_first(tmp_path: Path) -> None:
    process = hold(tmp_path / "f")
    with pytest.raises(InputError) as refused:
        FolderLock(tmp_path / "f")
    assert str(refused.value) == (
        f"{tmp_path / 'f'}: process {process.pid} on {socket.gethostname()} is writing here; "
        "wait for it, stop it, or choose another folder"
    )
    process.communicate("")
    with FolderLock(tmp_path / "f") as lock:
        assert lock.is_held
    assert not lock.is_held
    assert list((tmp_path / "f").iterdir()) == []


def test_a_killed_holder_holds_nothing(tmp_path: Path) -> None:
    process = hold(tmp_path)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert (tmp_path / LOCK_NAME).exists()
    with FolderLock(tmp_path):
        assert f"process {os.getpid()} " in (tmp_path / LOCK_NAME).read_text()
    assert not (tmp_path / LOCK_NAME).exists()


def test_one_process_cannot_take_it_twice_either(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path)
    with pytest.raises(InputError, match=f"process {os.getpid()} "):
        FolderLock(tmp_path)
    lock.release()
    lock.release()
    FolderLock(tmp_path).release()


def test_a_lock_file_removed_by_its_last_holder_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between our opening the file and our locking it, its holder lets go and a third process takes a new file."""
    real = carstudio.locks._lock
    third: list[FolderLock] = []

    def slow_lock(file: object) -> bool:
        monkeypatch.setattr(carstudio.locks, "_lock", real)
        (tmp_path / LOCK_NAME).unlink()
        third.append(FolderLock(tmp_path))
        return real(file)  # type: ignore[arg-type]  # what the caller handed over

    monkeypatch.setattr(carstudio.locks, "_lock", slow_lock)
    with pytest.raises(InputError, match="is writing here"):
        FolderLock(tmp_path)
    third[0].release()


def test_without_kernel_locks_it_goes_on_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(carstudio.locks, "fcntl", None)
    with FolderLock(tmp_path), FolderLock(tmp_path):
        assert (tmp_path / LOCK_NAME).exists()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(StorageError, match=r"file/below: cannot be written \(Not a directory\)"):
        FolderLock(tmp_path / "file" / "below")


# --- who takes it -----------------------------------------------------------------------------------------------------


def test_a_store_can_be_read_while_it_is_written_but_not_written_twice(tmp_path: Path) -> None:
    with StoreWriter(tmp_path / "s", source="toy") as writer:
        writer.append(toy_record(0, 0, 10.0))
        writer.flush()
        assert open_store(tmp_path / "s").patch_ids() == ["toy-0-0"]
        for write in (
            lambda: StoreWriter(tmp_path / "s", source="toy"),
            lambda: StoreWriter(tmp_path / "s", source="toy", mode="append"),
            lambda: open_store(tmp_path / "s").write_verdicts([]),
            lambda: open_store(tmp_path / "s").write_split("mine", {}),
        ):
            with pytest.raises(InputError, match=f"process {os.getpid()} .* is writing here"):
                write()
        open_store(tmp_path / "s", lock=writer.lock).write_verdicts([Verdict("toy-0-0", True)])
    store = open_store(tmp_path / "s")
    store.write_split("mine", {"toy-0-0": "test"})
    assert (store.split("mine"), [verdict.is_kept for verdict in store.verdicts()]) == ({"toy-0-0": "test"}, [True])
    assert not (tmp_path / "s" / LOCK_NAME).exists()


def test_a_writer_that_refuses_lets_go(tmp_path: Path) -> None:
    toy_store(tmp_path / "s", cars=1, views=1)
    with pytest.raises(InputError, match="already holds a finished store"):
        StoreWriter(tmp_path / "s", source="toy")
    FolderLock(tmp_path / "s").release()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "holiday.jpg").touch()
    with pytest.raises(InputError, match="no CarPatch3D store"):
        StoreWriter(tmp_path / "photos", source="toy")
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["holiday.jpg"]


def test_two_trainings_do_not_write_one_run(tmp_path: Path) -> None:
    store = toy_store(tmp_path / "s", cars=2, views=2)
    process = hold(tmp_path / "run")
    with pytest.raises(InputError, match=f"process {process.pid} "):
        train(TINY, store, tmp_path / "run", device="cpu")
    process.communicate("")
    train(TINY, store, tmp_path / "run", device="cpu")
