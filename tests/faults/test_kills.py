"""The harness: few kills in every run, fifty in the slow set, more by `./run faults --kills N`."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from faults.__main__ import main
from faults.forks import Forks
from faults.kills import NO_OPERATION, Reference, compare, make_reference, run_case
from faults.server import Ended, Request
from faults.targets import TARGETS, TRAIN, Target, store_snapshot


@pytest.mark.parametrize("name", ["train", "build", pytest.param("synth", marks=pytest.mark.slow)])
def test_killed_runs_end_in_the_same_bytes(name: str, forks: Forks, inputs: Path, tmp_path: Path) -> None:
    reference = make_reference(forks, TARGETS[name][0], inputs, tmp_path / "reference")
    cases = [run_case(forks, reference, inputs, tmp_path / f"case-{i}", f"test-{i}") for i in range(2)]
    assert [case.differences for case in cases] == [()] * len(cases)
    assert sum(len(case.kills) for case in cases) >= 1


def operations_that_finish(reference: Reference) -> range:
    """From the last shard on: verdicts, splits, manifest, lock."""
    return range(reference.operations - 24, reference.operations + 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["build", "synth"])
def test_a_kill_before_each_of_the_last_operations(name: str, forks: Forks, inputs: Path, tmp_path: Path) -> None:
    target = TARGETS[name][0]
    reference = make_reference(forks, target, inputs, tmp_path / "reference")
    for number in operations_that_finish(reference):
        out = tmp_path / str(number)
        request = Request(arguments=target.arguments(inputs, out), log=str(tmp_path / f"log-{number}"))
        assert forks.run(replace(request, at_operation=number)).code == -signal.SIGKILL
        ended = forks.run(request)
        assert ended.code == 0, Path(request.log).read_text()
        assert compare(reference.snapshot, target.snapshot(out)) == ()


@pytest.mark.slow
def test_fifty_kills(tmp_path: Path) -> None:
    assert main(["--kills", "50", "--seed", "1", "--keep", str(tmp_path)]) == 0
    assert list((tmp_path / "cases").iterdir()) == []


@pytest.mark.slow
def test_a_fork_writes_what_a_process_of_its_own_writes(trained: Path, inputs: Path, tmp_path: Path) -> None:
    program = (
        "import sys; from dataclasses import replace; from training.toy import TINY\n"
        "from carstudio.recipes import RECIPES\n"
        "RECIPES['tiny'] = lambda: replace(TINY, steps=24, log_every=3, save_every=4)\n"
        "from carstudio.cli import main; main()"
    )
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    command = [sys.executable, "-c", program, *TRAIN.arguments(inputs, tmp_path / "run")]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}, check=True)
    assert compare(TRAIN.snapshot(trained), TRAIN.snapshot(tmp_path / "run")) == ()


# --- does the harness see what it is there to see? --------------------------------------------------------------------


def test_a_restart_that_leaves_other_bytes_is_told_and_kept(forks: Forks, inputs: Path, tmp_path: Path) -> None:
    def all_frames(inputs: Path, out: Path) -> list[str]:
        return [*TARGETS["build"][0].arguments(inputs, out), "--frames", "0-17"]

    def fewer_frames(arguments: list[str], out: Path) -> list[str]:
        return [*arguments[:-1], "0-9"] if out.exists() else arguments

    target = replace(TARGETS["build"][0], arguments=all_frames, restart=fewer_frames)
    reference = make_reference(forks, target, inputs, tmp_path / "reference")
    case = run_case(forks, reference, inputs, tmp_path / "case", "test-0")
    assert "data/part-00001.parquet: differs" in case.differences
    assert "data/part-00002.parquet: missing" in case.differences
    assert "seed test-0" in (tmp_path / "case" / "case.txt").read_text()
    assert (tmp_path / "case" / "log").exists()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda out: (out / "data" / "part-0").write_text("y"), ("data/part-0: differs",)),
        (lambda out: (out / "data" / "part-0").unlink(), ("data/part-0: missing",)),
        (lambda out: (out / ".lock").touch(), (".lock: too much",)),
        (lambda out: (out / "runs" / "0002.json").touch(), ()),
        (
            lambda out: (out / "runs" / ".0002-abcdefgh.partial.json").touch(),
            ("runs/.0002-abcdefgh.partial.json: too much",),
        ),
    ],
)
def test_stores_are_compared_file_by_file(
    change: Callable[[Path], None], expected: tuple[str, ...], tmp_path: Path
) -> None:
    for folder in ("data", "runs"):
        (tmp_path / folder).mkdir()
    (tmp_path / "data" / "part-0").write_text("x")
    before = store_snapshot(tmp_path)
    change(tmp_path)
    assert compare(before, store_snapshot(tmp_path)) == expected


def test_the_seed_and_the_kill_stand_in_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--kills", "0"])
    assert stop.value.code == 2
    assert "--kills and --jobs must be at least 1" in capsys.readouterr().err


def failing(forks: Forks, target: Target, inputs: Path, folder: Path) -> Ended:
    arguments = [*target.arguments(inputs, folder), "--no-such-option"]
    return forks.run(Request(arguments=arguments, log=str(folder) + ".log", at_operation=NO_OPERATION))


def test_a_target_that_fails_by_itself_is_no_reference(forks: Forks, inputs: Path, tmp_path: Path) -> None:
    assert failing(forks, TRAIN, inputs, tmp_path / "out").code == 2
    broken = replace(TRAIN, arguments=lambda inputs, out: ["train", "no-such-recipe"])
    with pytest.raises(RuntimeError, match="train fails by itself"):
        make_reference(forks, broken, inputs, tmp_path)
