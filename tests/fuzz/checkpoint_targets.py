"""Targets: a trained model, the state a run goes on from, its log, and files of result rows."""

import json
import struct
from dataclasses import replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from safetensors import SafetensorError, safe_open
from torch import nn

from carstudio.errors import InputError
from carstudio.evaluation.results import ResultHeader, ResultRow, read_header, read_rows, write_rows
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.interface import PatchBatch, render_image
from carstudio.models.zoo import build_model
from carstudio.tensors import load_tensors, save_tensors
from carstudio.training.checkpoint import DESCRIPTION, WEIGHTS, load_model, save_model
from carstudio.training.log import LOG, read_log
from carstudio.training.resume import STATE, TrainingState, checksum, load_state, save_state
from fuzz.edits import Files
from fuzz.target import Target, write_files
from training.toy import TINY

HEADER, BODY = "header", "body"  # of a safetensors file taken apart; its length in front is put right by `join`
CONFIG = replace(TINY.model, width=8, depth=2, code_size=4, position_frequencies=2, colour_skip_px=2)


def take_apart(data: bytes) -> Files:
    """Header and numbers of a safetensors file."""
    (length,) = struct.unpack("<Q", data[:8])
    return {HEADER: data[8 : 8 + length], BODY: data[8 + length :]}


def join(files: Files, name: str) -> Files:
    """The inverse, with the right length in front; what was not taken apart stays as it is."""
    if HEADER not in files:
        return files
    kept = {key: data for key, data in files.items() if key not in (HEADER, BODY)}
    return {**kept, name: struct.pack("<Q", len(files[HEADER])) + files[HEADER] + files[BODY]}


@cache
def _model_files() -> Files:
    torch.manual_seed(0)
    with TemporaryDirectory() as folder:
        save_model(Path(folder), build_model(CONFIG), CONFIG, {"command": "train", "step": 3})
        return {name: (Path(folder) / name).read_bytes() for name in (WEIGHTS, DESCRIPTION)}


def model_seeds() -> list[Files]:
    """A small model whole; its header by itself; its description by itself."""
    files = _model_files()
    return [files, {**take_apart(files[WEIGHTS]), DESCRIPTION: files[DESCRIPTION]}, {DESCRIPTION: files[DESCRIPTION]}]


def mend_model(files: Files) -> Files:
    """The checksum in the description is that of the weights, whatever they are."""
    joined = {**_model_files(), **join(files, WEIGHTS)}
    try:
        value = json.loads(joined[DESCRIPTION])
        value["sha256"] = sha256(joined[WEIGHTS]).hexdigest()
        return {**joined, DESCRIPTION: json.dumps(value).encode()}
    except (ValueError, TypeError, RecursionError):
        return joined


def read_model(files: Files, folder: Path) -> None:
    """A model that is loaded encodes a patch and renders finite pictures."""
    write_files({**_model_files(), **join(files, WEIGHTS)}, folder)
    model = load_model(folder)
    assert all(tensor.isfinite().all() for tensor in model.state_dict().values())
    side = model.encoder_side_px
    assert 1 <= side <= 1024
    size = torch.tensor([4.0, 1.5, 1.8])
    box = orbit_box(size, azimuth_deg=40.0, elevation_deg=10.0, distance_m=9.0)
    batch = replace(box, center=box.center[None], size=box.size[None], rotation=box.rotation[None])
    camera = orbit_camera(4)
    patches = PatchBatch(torch.rand(1, 3, side, side), torch.ones(1, side, side), orbit_camera(side), batch, ("a",))
    with torch.no_grad():
        rendered = render_image(model, camera, model.encode(patches), batch)
    assert rendered["rgb"].shape == (4, 4, 3)
    assert all(picture.isfinite().all() for picture in rendered.values())


def _pupil() -> tuple[nn.Module, torch.optim.Optimizer]:
    """The smallest thing that can be trained: weights, a buffer that is no float, an optimiser with slots."""
    torch.manual_seed(0)
    model = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2))
    return model, torch.optim.RAdam(model.parameters(), lr=1e-3)


def _learn(model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    model(torch.linspace(-1, 1, 12).reshape(4, 3)).square().sum().backward()
    optimizer.step()


@cache
def _state_file() -> bytes:
    model, optimizer = _pupil()
    _learn(model, optimizer)
    with TemporaryDirectory() as folder:
        state = TrainingState.of(model, optimizer, step=1, seconds=0.5, starts_from="random weights")
        save_state(Path(folder), state)
        return (Path(folder) / STATE).read_bytes()


def state_seeds() -> list[Files]:
    """The state whole, and its header by itself."""
    return [{STATE: _state_file()}, take_apart(_state_file())]


def mend_state(files: Files) -> Files:
    """The header in one piece with its numbers, its checksum right where they can be read at all."""
    joined = join(files, STATE)
    try:
        with TemporaryDirectory() as folder:
            write_files(joined, Path(folder))
            tensors = load_tensors(Path(folder) / STATE)
            with safe_open(Path(folder) / STATE, "pt") as file:
                metadata = {key: value for key, value in (file.metadata() or {}).items() if key != "sha256"}
            save_tensors(Path(folder) / STATE, tensors, {**metadata, "sha256": checksum(tensors, metadata)})
            return {STATE: (Path(folder) / STATE).read_bytes()}
    except (InputError, SafetensorError, ValueError, RuntimeError):
        return joined


def read_state(files: Files, folder: Path) -> None:
    """What is resumed from goes on: one more step gives finite weights."""
    write_files(join(files, STATE), folder)
    state = load_state(folder)
    assert state.step >= 0
    assert state.seconds >= 0
    assert isinstance(state.starts_from, str)
    model, optimizer = _pupil()
    state.into(model, optimizer)
    _learn(model, optimizer)


@cache
def _row_files() -> Files:
    row = ResultRow(
        method="car-nerf", protocol="novel-view", split="instance", instance_id="car 1", patch_id="b",
        input_patch_id="a", psnr=20.5, psnr_mask=17.25, ssim=0.75, ssim_mask=0.5, lpips=None, mask_iou=0.875, seed=3,
        steps=1000, data_sha256="d" * 64, checkpoint_sha256="c" * 64,
    )  # fmt: skip
    with TemporaryDirectory() as folder:
        write_rows(Path(folder) / "rows.jsonl", [row, row], ResultHeader(reasons={"lpips": "not installed"}))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def read_result_rows(files: Files, folder: Path) -> None:
    """Rows that are read can be written and read again."""
    write_files(files, folder)
    rows, header = read_rows(folder / "rows.jsonl"), read_header(folder / "rows.jsonl")
    write_rows(folder / "again.jsonl", rows, header)
    assert read_rows(folder / "again.jsonl") == rows


LOG_LINES = b"".join(b'{"step": %d, "loss": 0.5, "psnr": 17.25}\n' % step for step in (20, 40, 60))


def read_training_log(files: Files, folder: Path) -> None:
    """Rows that a run could go on after."""
    write_files(files, folder)
    assert all(isinstance(row["step"], int) for row in read_log(folder / LOG))


CHECKPOINT_TARGETS = (
    Target("checkpoint", model_seeds, read_model, mend_model),
    Target("state", state_seeds, read_state, mend_state),
    Target("log", lambda: [{LOG: LOG_LINES}], read_training_log),
    Target("rows", lambda: [_row_files()], read_result_rows),
)
