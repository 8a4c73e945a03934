"""Makes .venv hold the project with the extras that a command needs, then becomes that command.

Called by ./run with any Python >= 3.11; standard library only. What makes it safe to interrupt and to repeat:
`ready.json` is removed before anything changes and written last, so an environment is whole or not trusted; a lock that
the kernel drops with the process keeps two runs apart; packages that a kill left half installed are found by their
RECORD and installed again. Messages go to stderr: stdout belongs to the command.
"""

import csv
import fcntl
import hashlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import FrameType
from typing import IO, Any, NoReturn

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
READY = VENV / "carstudio-ready.json"  # written last: this environment is whole
CREATED = VENV / "carstudio-created.json"  # written once the bare venv stands: packages may still be missing
CONSTRAINTS = VENV / "carstudio-constraints.txt"
LOG = VENV / "carstudio-setup.log"
GIGABYTE = 1e9
FRESH_SETUP_GB = 3.0  # measured: 1.9 GB in .venv with a CPU build of torch, plus what pip unpacks on the way
CUDA_TORCH_GB = 9.0  # the default wheels on Linux bring CUDA libraries: about 3 GB to download, 6 GB unpacked
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
NETWORK_SIGNS = ("NewConnectionError", "ConnectTimeout", "Name or service", "ProxyError", "No matching distribution")


class SetupError(Exception):
    """The machine lacks something; the message says what and how to get it."""


class Interrupted(BaseException):
    """A signal asked us to stop."""


def main(extras: str, command: list[str]) -> int:
    """Set up for `extras` (names separated by blanks or commas), then become `command` if there is one."""
    wanted = set(extras.replace(",", " ").split())
    for number in STOP_SIGNALS:
        signal.signal(number, _interrupt)
    try:
        if not is_ready(wanted):
            set_up(wanted)
        elif not command:
            say("ready: nothing to do")
    except SetupError as error:
        say(str(error))
        return 2
    except Interrupted as stop:
        say("interrupted; what is installed so far stays, the same command goes on from there")
        return 128 + int(stop.args[0])
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    return become(command) if command else 0


def become(command: list[str]) -> NoReturn:
    """Replace this process by the command, so that signals and its exit code pass straight through."""
    os.environ["VIRTUAL_ENV"] = str(VENV)
    os.environ["PATH"] = f"{VENV / 'bin'}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    os.execvp(command[0], command)


def say(message: str) -> None:
    """One line (or more) about the set-up."""
    print(f"run: {message}", file=sys.stderr, flush=True)


def _interrupt(number: int, frame: FrameType | None) -> None:
    for other in STOP_SIGNALS:
        signal.signal(other, signal.SIG_IGN)  # a second Ctrl-C must not stop the tidying up
    raise Interrupted(number)


# --- is it there already? ---------------------------------------------------------------------------------------------


def fingerprint() -> str:
    """Changes when the project's requirements change, not with the settings of its tools."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    parts = [project.get("build-system"), project.get("project"), project.get("tool", {}).get("setuptools")]
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def place() -> dict[str, str]:
    """What a venv is tied to: its own path (venvs cannot be moved) and the interpreter behind it."""
    return {"venv": str(VENV), "python": str(PYTHON.resolve())}


def is_ready(wanted: set[str]) -> bool:
    """Whether a whole environment stands that holds the project as it is now with all the wanted extras."""
    state = read_state(READY)
    is_whole = state.get("place") == place() and os.access(PYTHON, os.X_OK)
    return is_whole and state.get("fingerprint") == fingerprint() and wanted <= set(state.get("extras", []))


def read_state(path: Path) -> dict[str, Any]:
    """A marker's content; empty when it is missing or unreadable."""
    try:
        state = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Write a marker so that it is there whole or not at all."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(state, indent=2) + "\n", encoding="utf-8")
    partial.replace(path)


# --- making it --------------------------------------------------------------------------------------------------------


def set_up(wanted: set[str]) -> None:
    """Bring the environment to the wanted state; one process at a time."""
    with (ROOT / ".venv.lock").open("w") as lock:
        os.set_inheritable(lock.fileno(), True)  # a pip that outlives a killed parent keeps the lock
        wait_for_turn(lock)
        if is_ready(wanted):
            return
        start = time.monotonic()
        had = set(read_state(READY).get("extras", [])) | set(read_state(CREATED).get("extras", []))
        extras = sorted(wanted | had)
        READY.unlink(missing_ok=True)
        make_venv()
        write_state(CREATED, {"place": place(), "extras": sorted(had)})
        install_torch()
        install_project(extras)
        shutil.rmtree(VENV / "tmp", ignore_errors=True)
        write_state(READY, {"place": place(), "fingerprint": fingerprint(), "extras": extras})
        say(f"ready after {time.monotonic() - start:.0f} s")


def wait_for_turn(lock: IO[str]) -> None:
    """Take the lock; the kernel frees it when its holder ends, however it ends."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        say("another ./run is setting up this folder; waiting for it")
        fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError as error:  # a file system without locks (some network mounts): go on alone
        say(f"cannot lock {lock.name} ({error.strerror}); do not start a second set-up now")


def make_venv() -> None:
    """A bare venv with pip at `VENV`, or the one that stands, freed of half-installed packages."""
    if read_state(CREATED).get("place") == place() and os.access(PYTHON, os.X_OK):
        remove_half_installed()
        return
    require_venv_module()
    require_space(FRESH_SETUP_GB, "a fresh set-up needs about 2 GB")
    if VENV.exists():
        say(f"removing {VENV}: it is incomplete, was moved, or its Python is gone")
        shutil.rmtree(VENV)
    say(f"1/3 environment in {VENV} (Python {sys.version_info.major}.{sys.version_info.minor})")
    spawn([sys.executable, "-m", "venv", str(VENV)], "the environment could not be made")
    write_state(CREATED, {"place": place()})


def require_venv_module() -> None:
    """Debian splits ensurepip off into a package of its own; without it a venv has no pip."""
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        name = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
        raise SetupError(
            f"{sys.executable} cannot make environments: its venv or ensurepip module is missing.\n"
            f"     Debian and Ubuntu: apt install {name} (or python3-venv); elsewhere: install Python from python.org"
        )


def require_space(needed_gb: float, why: str) -> None:
    """Stop early rather than in the middle of an installation."""
    free_gb = shutil.disk_usage(ROOT).free / GIGABYTE
    if free_gb < needed_gb:
        raise SetupError(
            f"{free_gb:.1f} GB free on the disk of {ROOT}, at least {needed_gb:.0f} GB wanted: {why}.\n"
            "     Free some space, or put the checkout on another disk"
        )


def remove_half_installed() -> None:
    """Forget packages whose files are not all there (a kill in the middle of pip): pip then installs them again."""
    for site in VENV.glob("lib/python*/site-packages"):
        for leftover in site.glob("~*"):  # pip's own name for what it was replacing
            shutil.rmtree(leftover, ignore_errors=True)
        for info in site.glob("*.dist-info"):
            if not is_whole_package(site, info):
                say(f"repairing {info.name.removesuffix('.dist-info')}: it was half installed")
                shutil.rmtree(info)


def is_whole_package(site: Path, info: Path) -> bool:
    """Whether pip finished (RECORD is its last file) and every recorded file has its recorded size."""
    try:
        rows = list(csv.reader((info / "RECORD").read_text(encoding="utf-8").splitlines()))
        # Files without a size are those pip makes itself; byte code comes and goes.
        return all((site / row[0]).stat().st_size == int(row[2]) for row in rows if row[2] and row[0][-4:] != ".pyc")
    except (OSError, ValueError, IndexError):
        return False


def install_torch() -> None:
    """A suitable torch that is there stays; else pip's find-links, else TORCH_INDEX_URL, else pip's default index."""
    if torch_version() is None:
        index = os.environ.get("TORCH_INDEX_URL")
        say("2/3 PyTorch")
        if pip("--no-index", "--no-deps", "torch>=2.6", may_fail=True):
            pass
        elif index:
            pip("--no-deps", "--index-url", index, "torch>=2.6")
        else:
            if sys.platform == "linux":
                say("PyTorch with CUDA comes from the package index, about 3 GB; for the small CPU build stop now")
                say("and set TORCH_INDEX_URL=https://download.pytorch.org/whl/cpu")
                require_space(CUDA_TORCH_GB, "PyTorch with CUDA is large; the CPU build named above needs 3 GB")
            pip("torch>=2.6")
    version = torch_version()
    if version is None:
        raise SetupError(f"PyTorch >= 2.6 is not there after its installation; see {LOG}")
    CONSTRAINTS.write_text(f"torch=={version}\n", encoding="utf-8")


def torch_version() -> str | None:
    """Version of a torch >= 2.6 inside the environment, else None. Its metadata are read: importing takes seconds."""
    for info in VENV.glob("lib/python*/site-packages/torch-*.dist-info"):
        version = info.name.removeprefix("torch-").removesuffix(".dist-info")
        release = tuple(int(part) for part in version.split("+")[0].split(".")[:2] if part.isdigit())
        if release >= (2, 6):
            return version
    return None


def install_project(extras: list[str]) -> None:
    """The project, editable, with its extras and torch's own dependencies; the constraint keeps torch as it is."""
    names = f"[{','.join(extras)}]" if extras else ""
    say(f"3/3 Car-Studio and its packages{' with ' + ', '.join(extras) if extras else ''}")
    pip("--constraint", str(CONSTRAINTS), "--editable", f"{ROOT}{names}")


# --- running pip ------------------------------------------------------------------------------------------------------


def pip(*arguments: str, may_fail: bool = False) -> bool:
    """`pip install` inside the environment; output goes to a log, a failure shows its end."""
    command = [str(PYTHON), "-m", "pip", "install", "--no-input", "--disable-pip-version-check", *arguments]
    return spawn(command, "pip failed", may_fail=may_fail)


def spawn(command: list[str], failure: str, *, may_fail: bool = False) -> bool:
    """Run a command in its own process group, output in the log; the group ends when we are stopped."""
    temporary = VENV / "tmp"  # beside what it becomes: /tmp is often too small for torch
    temporary.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"TMPDIR": str(temporary), "PIP_USER": "0", "PYTHONNOUSERSITE": "1"}
    environment.pop("PYTHONPATH", None)
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
        close_fds=False,  # the lock goes along
    )
    lines: list[str] = []
    try:
        assert process.stdout is not None
        with LOG.open("a", encoding="utf-8") as file:
            file.write(f"$ {' '.join(command)}\n")
            for line in process.stdout:
                file.write(line)
                lines.append(line)
                show_progress(line)
        code = process.wait()
    except Interrupted:
        stop_group(process)
        raise
    finally:
        show_progress("")
    if code == 0 or may_fail:
        return code == 0
    raise SetupError(explain(failure, lines))


def stop_group(process: subprocess.Popen[str]) -> None:
    """End a process and everything it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(process.pid, number)
            process.wait(timeout=5)
        except ProcessLookupError:
            return
        except subprocess.TimeoutExpired:
            continue


def show_progress(line: str) -> None:
    """What pip is busy with, on one line that is overwritten; nothing where output is not a terminal."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns - 6
        sys.stderr.write(f"\r\033[K    {line.strip()[:width]}" if line else "\r\033[K")
        sys.stderr.flush()


def explain(failure: str, lines: list[str]) -> str:
    """The end of the output, and a guess at the cause where it is a common one."""
    text = "".join(lines)
    hint = ""
    if any(sign in text for sign in NETWORK_SIGNS):
        hint = "\n     The package index cannot be reached or lacks this: check the network, HTTPS_PROXY, PIP_INDEX_URL"
    elif "No space left" in text:
        hint = "\n     The disk is full"
    tail = "".join(f"     | {line}" for line in lines[-15:]).rstrip()
    return f"{failure}:\n{tail}{hint}\n     Full log: {LOG}. The same command goes on where it stopped"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
