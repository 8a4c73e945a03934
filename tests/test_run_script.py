"""The door ./run and its set-up: help, exit codes, missing Python, markers, repair, locks. No network, no real pip."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

SHELLS = [shell for shell in ("sh", "dash", "bash") if shutil.which(shell)]


@pytest.fixture
def checkout(repo_root: Path, tmp_path: Path) -> Path:
    """A copy of the door alone, in a folder with a blank in its name."""
    folder = tmp_path / "a check out"
    (folder / "tools").mkdir(parents=True)
    for name in ("run", "tools/environment.py", "pyproject.toml"):
        shutil.copy2(repo_root / name, folder / name)
    return folder


@pytest.fixture
def environment(checkout: Path) -> ModuleType:
    """tools/environment.py of the copy."""
    spec = importlib.util.spec_from_file_location("environment", checkout / "tools" / "environment.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pretend_ready(environment: ModuleType, extras: list[str]) -> None:
    """A bare venv marked as if everything had been installed."""
    environment.PYTHON.parent.mkdir(parents=True)
    environment.PYTHON.symlink_to(sys.executable)
    state = {"place": environment.place(), "fingerprint": environment.fingerprint(), "extras": extras}
    environment.write_state(environment.READY, state)


def door(checkout: Path, *arguments: str, shell: str = "sh", **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [shell, str(checkout / "run"), *arguments],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | variables,
        cwd=checkout.parent,
    )


@pytest.mark.parametrize("shell", SHELLS)
def test_without_an_argument_it_helps(checkout, shell):
    ended = door(checkout, shell=shell)
    assert ended.returncode == 0
    for verb in ("demo", "test", "carstudio", "python", "bench", "faults", "fuzz", "lint", "setup"):
        assert f"./run {verb}" in ended.stdout


@pytest.mark.parametrize("shell", SHELLS)
def test_an_unknown_command_is_named(checkout, shell):
    ended = door(checkout, "dmeo", shell=shell)
    assert ended.returncode == 2
    assert "'dmeo'" in ended.stderr
    assert ended.stdout == ""


def test_the_script_is_executable(repo_root):
    assert os.access(repo_root / "run", os.X_OK)
    assert os.access(repo_root / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize("shell", SHELLS)
def test_a_python_that_is_too_old_is_named_with_its_version(checkout, tmp_path, shell):
    old = tmp_path / "old python"
    old.write_text("#!/bin/sh\necho 3.9\nexit 1\n")
    old.chmod(0o755)
    ended = door(checkout, "setup", shell=shell, PYTHON=str(old))
    assert ended.returncode == 2
    assert f"found {old} is 3.9" in ended.stderr
    assert "3.11 or newer" in ended.stderr


def test_no_python_at_all_is_said(checkout):
    ended = door(checkout, "setup", PYTHON="/nowhere/python3")
    assert ended.returncode == 2
    assert "found none" in ended.stderr


@pytest.mark.parametrize("shell", SHELLS)
def test_the_commands_exit_code_arguments_and_output_pass_through(checkout, environment, shell):
    pretend_ready(environment, [])
    program = environment.VENV / "bin" / "carstudio"
    program.write_text('#!/bin/sh\nprintf "%s|" "$@"\npwd -P\nexit 7\n')
    program.chmod(0o755)
    ended = door(checkout, "carstudio", "render", "a car", "--out", "", shell=shell)
    assert ended.returncode == 7
    assert ended.stdout == f"render|a car|--out||{checkout.parent.resolve()}\n"  # the caller's folder, not ours
    assert ended.stderr == ""
    assert door(checkout, "demo", "--seed", "1", shell=shell).stdout.startswith("demo|--seed|1|")


def test_signals_reach_the_command(checkout, environment):
    """The door becomes the command: a signal to its process is a signal to the command."""
    pretend_ready(environment, [])
    program = environment.VENV / "bin" / "carstudio"
    program.write_text("#!/bin/sh\necho started\nexec sleep 60\n")
    program.chmod(0o755)
    with subprocess.Popen(["sh", str(checkout / "run"), "carstudio"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "started\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == -signal.SIGTERM


# --- when is an environment trusted? ----------------------------------------------------------------------------------


def test_ready_means_this_place_these_requirements_and_extras(environment, checkout):
    assert not environment.is_ready(set())
    pretend_ready(environment, ["dev"])
    assert environment.is_ready(set())
    assert environment.is_ready({"dev"})
    assert not environment.is_ready({"dev", "view"})
    project = checkout / "pyproject.toml"
    project.write_text(project.read_text().replace("line-length = 120", "line-length = 119"))
    assert environment.is_ready({"dev"})  # a tool's setting is no requirement
    project.write_text(project.read_text().replace('"numpy>=1.26"', '"numpy>=1.27"'))
    assert not environment.is_ready({"dev"})


def test_a_moved_or_broken_environment_is_not_trusted(environment):
    pretend_ready(environment, [])
    state = json.loads(environment.READY.read_text())
    environment.write_state(environment.READY, state | {"place": {"venv": "/elsewhere", "python": "/usr/bin/python3"}})
    assert not environment.is_ready(set())
    environment.READY.write_text("{half")
    assert not environment.is_ready(set())
    environment.write_state(environment.READY, state)
    assert environment.is_ready(set())
    environment.PYTHON.unlink()
    environment.PYTHON.symlink_to("/nowhere/python3")
    assert not environment.is_ready(set())


# --- making one, with pip replaced ------------------------------------------------------------------------------------


@pytest.fixture
def fake_pip(environment, monkeypatch):
    """Records what would be installed; a torch appears where the real pip would put it."""
    calls: list[tuple[str, ...]] = []
    site = environment.VENV / "lib" / "python3.11" / "site-packages"

    def spawn(command, failure, *, may_fail=False):
        if command[1:3] == ["-m", "venv"]:
            environment.PYTHON.parent.mkdir(parents=True, exist_ok=True)
            environment.PYTHON.symlink_to(sys.executable)
            return True
        arguments = tuple(a for a in command[4:] if a not in ("--no-input", "--disable-pip-version-check"))
        calls.append(arguments)
        if "torch>=2.6" in arguments:
            if "--no-index" in arguments and calls_fail_without_index:
                return False
            (site / "torch-2.9.1+cpu.dist-info").mkdir(parents=True)
            (site / "torch-2.9.1+cpu.dist-info" / "RECORD").touch()
        return True

    calls_fail_without_index: list[bool] = []
    monkeypatch.setattr(environment, "spawn", spawn)
    monkeypatch.setattr(environment, "require_space", lambda *_: None)
    monkeypatch.delenv("TORCH_INDEX_URL", raising=False)
    return calls, calls_fail_without_index


def test_a_fresh_set_up_pins_the_torch_that_is_there(environment, fake_pip):
    calls, _ = fake_pip
    environment.set_up({"dev"})
    assert calls[0] == ("--no-index", "--no-deps", "torch>=2.6")
    assert environment.CONSTRAINTS.read_text() == "torch==2.9.1+cpu\n"
    assert calls[1] == ("--constraint", str(environment.CONSTRAINTS), "--editable", f"{environment.ROOT}[dev]")
    assert environment.is_ready({"dev"})
    environment.set_up({"dev", "view"})  # another extra: torch stays, both extras are kept
    assert len(calls) == 3
    assert calls[2][-1].endswith("[dev,view]")


def test_without_a_local_wheel_the_named_index_is_used_then_the_default(environment, fake_pip, monkeypatch):
    calls, without_index_fails = fake_pip
    without_index_fails.append(True)
    monkeypatch.setenv("TORCH_INDEX_URL", "https://example.org/cpu")
    environment.set_up(set())
    assert calls[1] == ("--no-deps", "--index-url", "https://example.org/cpu", "torch>=2.6")
    shutil.rmtree(environment.VENV)
    calls.clear()
    monkeypatch.delenv("TORCH_INDEX_URL")
    environment.set_up(set())
    assert calls[1] == ("torch>=2.6",)


@pytest.mark.parametrize(
    ("version", "kept"), [("2.6.0", True), ("2.13.0+cpu", True), ("3.0", True), ("2.5.1", False), ("1.13.1", False)]
)
def test_a_torch_that_is_new_enough_is_kept(environment, version, kept):
    (environment.VENV / "lib" / "python3.11" / "site-packages" / f"torch-{version}.dist-info").mkdir(parents=True)
    assert environment.torch_version() == (version if kept else None)


def test_an_interrupted_set_up_is_not_ready_and_goes_on(environment, fake_pip, monkeypatch):
    calls, _ = fake_pip

    def stop(extras):
        raise environment.Interrupted(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(environment, "install_project", stop)
        with pytest.raises(environment.Interrupted):
            environment.set_up({"dev"})
    assert not environment.is_ready(set())
    environment.set_up({"dev"})
    assert environment.is_ready({"dev"})
    assert sum("torch>=2.6" in c for c in calls) == 1  # a whole torch is not installed twice


def test_half_installed_packages_are_found_by_their_record(environment):
    site = environment.VENV / "lib" / "python3.11" / "site-packages"
    for name, record in {
        "whole": "whole.py,sha256=x,5\nwhole-1.dist-info/RECORD,,\n",
        "short": "short.py,sha256=x,500\n",
        "missing": "nowhere.py,sha256=x,5\n",
        "unfinished": None,
    }.items():
        (site / f"{name}-1.dist-info").mkdir(parents=True)
        (site / f"{name}.py").write_text("X = 1")
        if record is not None:
            (site / f"{name}-1.dist-info" / "RECORD").write_text(record)
    (site / "~umpy").mkdir()
    environment.remove_half_installed()
    assert [p.name for p in site.glob("*-info")] == ["whole-1.dist-info"]
    assert not (site / "~umpy").exists()


# --- what is missing is said plainly ----------------------------------------------------------------------------------


def test_missing_venv_module_names_debians_package(environment, monkeypatch):
    monkeypatch.setattr(environment.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(environment.SetupError, match=r"apt install python3\.\d+-venv"):
        environment.require_venv_module()


def test_a_full_disk_is_said_before_anything_is_made(environment, monkeypatch):
    monkeypatch.setattr(environment.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(9e9, 8e9, 1e9))
    with pytest.raises(environment.SetupError, match=r"1\.0 GB free .* at least 3 GB"):
        environment.set_up(set())
    assert not environment.VENV.exists()


def test_a_failing_command_shows_its_end_and_a_reason(environment):
    program = "print('Collecting x'); print('NewConnectionError: Name or service not known'); raise SystemExit(1)"
    with pytest.raises(environment.SetupError, match=r"(?s)\| Collecting x.*cannot be reached"):
        environment.spawn([sys.executable, "-c", program], "pip failed")
    assert "Collecting x" in environment.LOG.read_text()
    assert environment.spawn([sys.executable, "-c", program], "pip failed", may_fail=True) is False


def test_a_signal_takes_the_whole_group_of_processes_down(checkout, environment, tmp_path):
    """SIGTERM in the middle of pip: 143, no child left, nothing that looks whole."""
    mark = tmp_path / "child"
    child = f"import os, time, pathlib; pathlib.Path({str(mark)!r}).write_text(str(os.getpid())); time.sleep(60)"
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import environment as e\n"
        f"e.set_up = lambda wanted: e.spawn([sys.executable, '-c', {child!r}], 'failed')\n"
        "sys.exit(e.main('', []))\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(checkout / "tools")], stderr=subprocess.PIPE, text=True
    )
    for _ in range(400):
        if mark.exists() and mark.read_text():
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 143
    assert "interrupted" in said
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_two_set_ups_wait_for_each_other(checkout, environment):
    program = (
        "import sys, time; sys.path.insert(0, sys.argv[1]); import environment as e\n"
        "with (e.ROOT / '.venv.lock').open('w') as lock:\n"
        "    e.wait_for_turn(lock); print('in', flush=True); time.sleep(0.5); print('out', flush=True)\n"
    )
    command = [sys.executable, "-c", program, str(checkout / "tools")]
    with (checkout / "out.txt").open("w") as out:
        both = [subprocess.Popen(command, stdout=out, stderr=subprocess.DEVNULL) for _ in range(2)]
        assert [process.wait(timeout=60) for process in both] == [0, 0]
    assert (checkout / "out.txt").read_text().split() == ["in", "out", "in", "out"]
