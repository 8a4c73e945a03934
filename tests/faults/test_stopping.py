"""Ctrl-C and SIGTERM by real signals: exit codes, what is said, what is left, and that it goes on to the same bytes."""

import os
import shlex
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from carstudio.dataset.workers import _submit
from carstudio.signals import STOP_SIGNALS, held_back_stops
from faults.forks import Forks
from faults.kills import compare, make_reference
from faults.server import ORPHANS_MAY_TAKE_S, Request
from faults.targets import TARGETS, TRAIN, files_of

STOPS = {signal.SIGINT: 130, signal.SIGTERM: 143}


def long_run(verb: str, inputs: Path, trained: Path, out: Path) -> list[str]:
    """A command line that would take minutes."""
    data = ["--data", str(inputs / "cars"), "--device", "cpu"]
    if verb == "train":
        return ["train", "car-nerf-small", *data, "--out", str(out), "--split", "None", "--pictures", "0"]
    if verb == "build":
        return TARGETS["build"][3].arguments(inputs, out)
    if verb == "evaluate":
        rows = ["--protocol", "novel-view", "--split", "none", "--out", str(out / "rows.jsonl")]
        return ["evaluate", str(trained), *data, *rows]
    if verb == "render":
        return ["render", str(trained), *data, "--out", str(out), "--patches", "toy-0-0", "--size", "512"]
    many = ["--cars", "500", "--views", "8", "--out", str(out)]
    return ["demo", *many] if verb == "demo" else ["synth", *many, "--size", "256", "--workers", verb[-1]]


# When the signal comes: while workers start, at work in one process, in workers at work, in a step of training, before
# the first score (the first file operation is the check that rows can be written), in a picture, among imports.
CASES: list[tuple[str, dict[str, float]]] = [
    ("build", {"after_s": 0.4}),
    ("synth-1", {"after_s": 0.8}),
    ("synth-2", {"after_s": 4.0}),
    ("train", {"after_s": 1.5}),
    ("evaluate", {"at_operation": 1}),
    ("render", {"after_s": 0.8}),
    ("demo", {"after_s": 0.5}),
]


@pytest.mark.parametrize(
    ("verb", "when", "to_group"),
    [(*case, True) for case in CASES] + [(*case, False) for case in CASES if case[0] in ("build", "train", "demo")],
)
def test_a_verb_ends_and_says_how_to_go_on(
    verb: str, when: dict[str, float], to_group: bool, forks: Forks, inputs: Path, trained: Path, tmp_path: Path
) -> None:
    number = signal.SIGINT if to_group else signal.SIGTERM
    out, log = tmp_path / "out", tmp_path / "log"
    arguments = long_run(verb, inputs, trained, out)
    ended = forks.run(
        Request(arguments=arguments, log=str(log), signal=number, to_group=to_group, **when)  # type: ignore[arg-type]
    )
    shown = log.read_text()
    assert ended.code == STOPS[number], shown
    first, second, *rest = shown.splitlines()
    assert first.startswith("interrupted; ")
    assert second.startswith(f"go on with: carstudio {arguments[0]} ")
    assert rest == []
    assert [path for path in files_of(out) if ".partial" in path] == []


def test_workers_of_a_killed_parent_end_by_themselves(
    forks: Forks, inputs: Path, trained: Path, tmp_path: Path
) -> None:
    arguments = long_run("synth-2", inputs, trained, tmp_path / "out")
    ended = forks.run(Request(arguments=arguments, log=str(tmp_path / "log"), after_s=4.0, to_group=False))
    assert ended.code == -signal.SIGKILL
    assert ended.orphans_s < ORPHANS_MAY_TAKE_S, "they had to be killed"


def test_training_goes_on_from_the_step_it_was_stopped_in(forks: Forks, inputs: Path, tmp_path: Path) -> None:
    reference = make_reference(forks, TRAIN, inputs, tmp_path / "reference")
    out, log = tmp_path / "out", tmp_path / "log"
    arguments = TRAIN.arguments(inputs, out)
    stopped = 0
    for share in (0.3, 0.5, 0.6, 0.7):
        log.unlink(missing_ok=True)
        request = Request(
            arguments=TRAIN.restart(arguments, out),
            log=str(log),
            after_s=share * reference.seconds,
            signal=signal.SIGINT,
        )
        ended = forks.run(request)
        if ended.code == 0:
            break
        assert ended.code == 130
        stopped += 1
        shown = log.read_text()
        assert shown.endswith(f"go on with: carstudio {shlex.join(TRAIN.restart(arguments, out))}\n"), shown
    forks.run(Request(arguments=TRAIN.restart(arguments, out), log=str(log)))
    assert stopped > 0
    assert compare(reference.snapshot, TRAIN.snapshot(out)) == ()


def start(program: str, *arguments: str) -> subprocess.Popen[str]:
    """A Python of its own, which says "ready" when the signal may come."""
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


DEEP = """
import hashlib, sys, threading
from carstudio.commands.stopping import StopWatch
watch = StopWatch()
watch.farewell = lambda: "goodbye"
watch.start()
print("ready", flush=True)
hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000_000)  # an hour in C, without the interpreter's lock
"""


def test_what_is_deep_in_a_library_is_ended_by_the_watch() -> None:
    process = start(DEEP)
    time.sleep(0.2)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (143, "goodbye\n")


def test_nothing_is_raised_while_modules_are_imported() -> None:
    """Some libraries catch whatever is raised during their imports and go on."""
    swallow = 'import os\ntry:\n    os.kill(os.getpid(), 15)\nexcept BaseException:\n    pass\nprint("still here")\n'
    process = start(DEEP[: DEEP.index("hashlib.pbkdf2")] + swallow)
    printed, said = process.communicate(timeout=60)
    assert (process.returncode, printed, said) == (143, "", "goodbye\n")


def test_a_second_signal_does_not_wait() -> None:
    patient = "import carstudio.commands.stopping as stopping\nstopping.GRACE_S = 3600\nwatch.start()"
    process = start(DEEP.replace("watch.start()", patient))
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    time.sleep(0.2)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert (process.returncode, said) == (130, "goodbye\n")


def test_the_console_script_itself_hears_ctrl_c_with_workers(inputs: Path, tmp_path: Path) -> None:
    """No fork of a server: a process and a group of its own, as in a terminal."""
    program = "print('ready', flush=True); from carstudio.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "synth", "--cars", "500", "--out", str(tmp_path / "s"), "--workers", "2"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "s" / "runs").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1.0)  # workers are starting
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert said.splitlines()[0] == f"interrupted; 0 patches in whole shards are saved in {tmp_path / 's'}"
    assert len(said.splitlines()) == 2, said


def test_stops_held_back_take_effect_at_the_end_of_the_block() -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        with held_back_stops() as stops:
            os.kill(os.getpid(), signal.SIGTERM)
            assert (stops, heard) == ([signal.SIGTERM], [])
        assert heard == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_nothing_held_back_changes_nothing() -> None:
    before = signal.getsignal(signal.SIGINT)
    with held_back_stops() as stops:
        assert stops == []
    assert signal.getsignal(signal.SIGINT) == before
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: held_back_stops().__enter__()).result() == []


def test_no_signal_is_heard_while_a_worker_starts() -> None:
    """A worker started by a pool that was interrupted before it had noted it would be left alone."""
    heard: list[int] = []
    seen: list[object] = []

    class Pool(ProcessPoolExecutor):
        def submit(self, *arguments: Any) -> Future[Any]:  # type: ignore[override]  # it takes all and runs nothing
            os.kill(os.getpid(), signal.SIGTERM)
            seen.append((list(heard), signal.pthread_sigmask(signal.SIG_BLOCK, ()) >= set(STOP_SIGNALS)))
            return Future()

    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    try:
        _submit(Pool(1), str, [1])
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (seen, heard) == ([([], True)], [signal.SIGTERM])
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(STOP_SIGNALS)
