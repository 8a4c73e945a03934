"""What gets killed: small runs of train, build and synth; what they must leave; where a kill found them."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from safetensors import safe_open

from carstudio.files import is_partial
from dataset.made_up_kitti import made_up_kitti
from training.toy import toy_store

STEPS = 24


@dataclass(frozen=True)
class Target:
    """A command that writes `out`; the inputs lie in a folder made by `make_inputs`."""

    name: str
    arguments: Callable[[Path, Path], list[str]]
    """(inputs, out) -> the command line."""
    restart: Callable[[list[str], Path], list[str]]
    """(command line, out) -> the command line after a kill."""
    snapshot: Callable[[Path], dict[str, str]]
    """out -> name -> digest: what must be equal to an uninterrupted run."""
    landed: Callable[[Path], str]
    """out after a kill -> where it was."""


def make_inputs(folder: Path) -> None:
    """The toy cars to train on and the pictures to build from."""
    toy_store(folder / "cars", cars=3, views=4)
    made_up_kitti(folder / "kitti", more_frames=15)


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def files_of(out: Path) -> dict[str, Path]:
    """Every file below `out`, hidden ones too: nothing half-written may stay."""
    return {str(path.relative_to(out)): path for path in sorted(out.rglob("*")) if path.is_file()}


# --- stores -----------------------------------------------------------------------------------------------------------


def store_snapshot(out: Path) -> dict[str, str]:
    """All bytes but those of `runs/`, which tell of every start."""
    files = files_of(out)
    leftovers = [name for name, path in files.items() if is_partial(path)]
    found = {name: digest(path.read_bytes()) for name, path in files.items() if not name.startswith("runs/")}
    return found | {name: "left over" for name in leftovers}


def landed_in_store(out: Path) -> str:
    partials = [path.relative_to(out).parts for path in out.rglob(".*.partial*")] if out.exists() else []
    if partials:
        place = partials[0][0] if len(partials[0]) > 1 else partials[0][0].split("-")[0].strip(".")
        return f"while writing {place}"
    if not (out / "manifest.json").exists():
        return "before the manifest"
    if json.loads((out / "manifest.json").read_text())["is_finished"]:
        return "after the end"
    if (out / "verdicts.parquet").exists():
        return "judged, not finished"
    return "between shards" if any((out / "data").glob("part-*")) else "before the first shard"


# --- a training -------------------------------------------------------------------------------------------------------


def run_snapshot(out: Path) -> dict[str, str]:
    """Model, log and pictures byte by byte; the state by tensors and step (its seconds differ); nothing else."""
    files = files_of(out)
    found = {name: digest(path.read_bytes()) for name, path in files.items() if name not in _SPECIAL}
    if "model.json" in files:
        value = json.loads(files["model.json"].read_text())
        del value["provenance"]["command"]  # it says --resume
        found["model.json"] = digest(json.dumps(value).encode())
    if "training.safetensors" in files:
        found["training.safetensors"] = _state_digest(files["training.safetensors"])
    return found


_SPECIAL = ("model.json", "training.safetensors")


def _state_digest(path: Path) -> str:
    with safe_open(path, "pt") as file:
        parts = [file.metadata()["step"].encode()]
        for name in sorted(file.keys()):  # not a dict
            parts += [name.encode(), file.get_tensor(name).numpy().tobytes()]
    return digest(b"\0".join(parts))


def landed_in_run(out: Path) -> str:
    partials = [path.name.split("-")[0].strip(".") for path in out.rglob(".*.partial*")] if out.exists() else []
    if partials:
        return f"while writing {'a picture' if partials[0] == 'step' else partials[0]}"
    if not (out / "log.jsonl").exists():
        return "before the log"
    if not (out / "training.safetensors").exists():
        return "before the first checkpoint"
    with safe_open(out / "training.safetensors", "pt") as file:
        step = int(file.metadata()["step"])
    return "after the end" if step == STEPS else "between checkpoints"


def _with_resume(arguments: list[str], out: Path) -> list[str]:
    has_checkpoint = (out / "training.safetensors").exists()
    return [*arguments, "--resume"] if has_checkpoint else arguments


TRAIN = Target(
    "train",
    lambda inputs, out: [
        *("train", "tiny", "--data", str(inputs / "cars"), "--out", str(out), "--split", "None"),
        *("--steps", str(STEPS), "--device", "cpu", "--pictures", "1", "--quiet"),
    ],
    _with_resume,
    run_snapshot,
    landed_in_run,
)


def _build(workers: int) -> Target:
    return Target(
        "build",
        lambda inputs, out: [
            *("build", "kitti-mot", "--root", str(inputs / "kitti"), "--out", str(out), "--no-report"),
            *("--workers", str(workers), "--quiet"),
        ],
        lambda arguments, out: arguments,
        store_snapshot,
        landed_in_store,
    )


def _synth(workers: int) -> Target:
    return Target(
        "synth",
        lambda inputs, out: [
            *("synth", "--cars", str(4 * workers), "--views", "4", "--size", "16", "--out", str(out)),
            *("--workers", str(workers), "--quiet"),
        ],
        lambda arguments, out: arguments,
        store_snapshot,
        landed_in_store,
    )


# Several variants of one command: in one process, and with workers (whose start takes seconds: the rarer case).
TARGETS: dict[str, tuple[Target, ...]] = {
    "train": (TRAIN,),
    "build": (_build(1), _build(1), _build(1), _build(2)),
    "synth": (_synth(1), _synth(1), _synth(1), _synth(2)),
}
