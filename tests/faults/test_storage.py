"""A disk that takes no more and a folder that may not be written: one message, nothing half-written, then all is well.

A file-size limit stands for a full disk where nothing may be mounted: writes fail in the middle, in our code as in
pyarrow's, safetensors' and Pillow's.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from faults.forks import Forks
from faults.kills import compare, make_reference
from faults.server import Request
from faults.targets import TARGETS, TRAIN, Target, files_of

BUILD = TARGETS["build"][0]


def arguments_of(verb: str, inputs: Path, trained: Path, out: Path) -> list[str]:
    if verb in TARGETS:
        return TARGETS[verb][0].arguments(inputs, out)
    common = [verb, str(trained), "--data", str(inputs / "cars"), "--device", "cpu"]
    if verb == "evaluate":
        return [*common, "--protocol", "novel-view", "--split", "none", "--out", str(out / "rows.jsonl")]
    return [*common, "--patches", "toy-0-0", "--views", "3", "--size", "64", "--out", str(out)]


FULL = [  # verb, largest file in bytes, the first file that does not fit, what is said to be saved
    ("train", 0, "log.jsonl", "no checkpoint is there yet"),
    ("train", 3_000, "model.safetensors", "no checkpoint is there yet"),
    ("build", 0, "manifest.json", "0 patches in whole shards are saved"),
    ("build", 3_000, "data/part-00000.parquet", "0 patches in whole shards are saved"),
    ("synth", 8_000, "data/part-00000.parquet", "0 patches in whole shards are saved"),
    ("evaluate", 3_000, "rows.jsonl", "no row was written"),
    ("render", 0, "toy-0-0/input.png", "pictures finished so far are whole"),
    ("render", 3_000, "toy-0-0/turntable.gif", "pictures finished so far are whole"),
]


@pytest.mark.parametrize(("verb", "limit", "name", "saved"), FULL)
def test_a_full_disk(
    verb: str, limit: int, name: str, saved: str, forks: Forks, inputs: Path, trained: Path, tmp_path: Path
) -> None:
    out, log = tmp_path / "out", tmp_path / "log"
    request = Request(arguments=arguments_of(verb, inputs, trained, out), log=str(log), file_bytes=limit)
    assert forks.run(request).code == 2
    shown = log.read_text()
    assert f"error: {out / name}: cannot be written (" in shown
    assert "File too large" in shown
    assert saved in shown
    assert f"go on with: carstudio {verb} " in shown
    assert "Traceback" not in shown
    assert [path for path in files_of(out) if Path(path).name.startswith(".")] == []
    assert forks.run(Request(arguments=request.arguments, log=str(log))).code == 0, log.read_text()
    if verb == "train":
        assert compare(TRAIN.snapshot(trained), TRAIN.snapshot(out)) == ()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="gives up root's rights with Linux capabilities")
@pytest.mark.parametrize("verb", ["train", "build", "synth", "evaluate", "render"])
def test_a_read_only_folder(verb: str, forks: Forks, inputs: Path, trained: Path, tmp_path: Path) -> None:
    out, log = tmp_path / "out", tmp_path / "log"
    out.mkdir(mode=0o555)
    arguments = arguments_of(verb, inputs, trained, out)
    assert forks.run(Request(arguments=arguments, log=str(log), obeys_permissions=True)).code == 2
    shown = log.read_text()
    assert f"error: {out}" in shown
    assert "cannot be written (Permission denied); make room or permit writing there" in shown
    assert "Traceback" not in shown
    out.chmod(0o755)
    assert files_of(out) == {}
    assert forks.run(Request(arguments=arguments, log=str(log))).code == 0, log.read_text()


@pytest.mark.parametrize(("target", "shares"), [(TRAIN, (0.35, 0.6, 0.95)), (BUILD, (0.2, 0.5, 0.8))])
def test_a_disk_that_fills_up_later_keeps_what_was_saved(
    target: Target, shares: tuple[float, ...], forks: Forks, inputs: Path, tmp_path: Path
) -> None:
    """Nothing can be opened, made or renamed any more from some operation on."""
    reference = make_reference(forks, target, inputs, tmp_path / "reference")
    for share in shares:
        out, log = tmp_path / f"out-{share}", tmp_path / f"log-{share}"
        arguments = target.arguments(inputs, out)
        number = round(share * reference.operations)
        assert forks.run(Request(arguments=arguments, log=str(log), full_at_operation=number)).code == 2
        shown = log.read_text()
        assert f"error: {out}" in shown
        assert "cannot be written (No space left on device)" in shown
        assert re.search(r"\n(step \d+ is|\d+ patches in whole shards are|no checkpoint)", shown), shown
        assert "Traceback" not in shown
        assert [path for path in files_of(out) if Path(path).name.startswith(".")] == []
        again = target.restart(arguments, out)
        assert f"go on with: carstudio {shlex.join(again)}\n" in shown
        assert forks.run(Request(arguments=again, log=str(log))).code == 0, log.read_text()
        assert compare(reference.snapshot, target.snapshot(out)) == ()


@pytest.mark.slow
def test_a_disk_that_is_full_from_any_operation_on(forks: Forks, inputs: Path, tmp_path: Path) -> None:
    reference = make_reference(forks, BUILD, inputs, tmp_path / "reference")
    for number in range(1, reference.operations + 1):
        out, log = tmp_path / str(number), tmp_path / f"log-{number}"
        request = Request(arguments=BUILD.arguments(inputs, out), log=str(log))
        assert forks.run(replace(request, full_at_operation=number)).code in (0, 2), log.read_text()
        assert "Traceback" not in log.read_text()
        assert forks.run(request).code == 0, log.read_text()
        assert compare(reference.snapshot, BUILD.snapshot(out)) == ()


def can_mount() -> bool:
    """Whether this user may have a file system of their own (unprivileged user namespaces)."""
    command = ["unshare", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "none", "/mnt"]
    return shutil.which("unshare") is not None and subprocess.run(command, capture_output=True).returncode == 0


@pytest.mark.slow
def test_a_disk_that_is_really_full(inputs: Path, tmp_path: Path) -> None:
    if not can_mount():
        pytest.skip("may not mount a file system here")
    disk = tmp_path / "disk"
    disk.mkdir()
    program = "from carstudio.cli import main; main()"
    train = ["train", "car-nerf-small", "--data", str(inputs / "cars"), "--out", str(disk / "run")]
    script = 'mount -t tmpfs -o size=300k none "$0" && "$@"; code=$?; ls -A "$0/run"; exit $code'
    on_disk = ["unshare", "--map-root-user", "--mount", "sh", "-c", script, str(disk)]
    ended = subprocess.run(
        [*on_disk, sys.executable, "-c", program, *train, "--split", "None", "--steps", "1", "--device", "cpu"],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert ended.returncode == 2, ended.stderr
    assert f"error: {disk / 'run' / 'model.safetensors'}: cannot be written (" in ended.stderr
    assert "No space left on device" in ended.stderr
    assert ended.stdout.split() == ["log.jsonl"]
