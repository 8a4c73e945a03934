"""What is fuzzed: for each target valid files to damage, and a reader that must give a sound value or `InputError`.

A new target is one entry of `TARGETS`: seeds, and a function of the damaged bytes and an empty folder.
"""

import json
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from carstudio.dataset.legacy_json.importer import LegacyJob, open_legacy
from carstudio.dataset.manifest import read_manifest
from carstudio.dataset.sources.kitti_format import (
    center_in_camera,
    group_tracking_lines,
    parse_calibration,
    parse_labels,
)
from carstudio.dataset.store import open_store
from carstudio.dataset.verify import record_problems
from carstudio.errors import InputError
from carstudio.evaluation.results import read_rows
from carstudio.files import read_json
from carstudio.images import decode_depth, decode_image, encode_jpeg, encode_png, image_size
from carstudio.models.zoo import build_model
from carstudio.training.checkpoint import describe_model, load_model, save_model
from carstudio.training.log import read_log
from carstudio.training.resume import STATE, TrainingState, load_state, save_state
from dataset.authors_files import write_subset
from training.toy import TINY, toy_store

LABELS = b"""Car 0.00 0 -1.57 599.41 156.40 629.75 189.25 2.85 2.63 12.34 0.47 1.49 69.44 -1.56
Van 0.00 2 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57 0.97
DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10
"""
TRACKS = b"".join(b"%d %d %s\n" % (i, i % 2, line) for i, line in enumerate(LABELS.splitlines()))
CALIBRATION = b"""P0: 7.215377e+02 0 6.095593e+02 0 0 7.215377e+02 1.728540e+02 0 0 0 1 0
P2: 7.215377e+02 0.0 6.095593e+02 4.485728e+01 0.0 7.215377e+02 1.728540e+02 2.163791e-01 0 0 1 2.745884e-03
R0_rect 9.999239e-01 9.837760e-03 -7.445048e-03 -9.869795e-03 9.999421e-01 -4.278459e-03 7.402527e-03 4.351614e-03 1
"""


@dataclass(frozen=True)
class Target:
    """Seeds to damage, and what reads them. `read` returns nothing; it asserts that what it read is sound."""

    seeds: Callable[[Path], list[bytes]]
    read: Callable[[bytes, Path], None]


def _text(data: bytes) -> str:
    return data.decode("utf-8", errors="replace")


def read_labels(data: bytes, folder: Path) -> None:
    """Each line by itself, as the sources read them."""
    for line in _text(data).splitlines():
        try:
            labels = parse_labels(line, name="f")
        except InputError:
            continue
        for label in labels:
            assert label.size is None or all(0 < side < math.inf for side in label.size), label
            center = center_in_camera(label, (0.06, 0.0, 0.003))
            assert center is None or all(math.isfinite(value) for value in center), center


def read_tracks(data: bytes, folder: Path) -> None:
    """Frames and tracks of a tracking file."""
    frames, problems = group_tracking_lines(_text(data), name="f")
    assert all(isinstance(frame, int) for frame in frames)
    assert all("f line" in problem for problem in problems)


def read_calibration(data: bytes, folder: Path) -> None:
    """Focal lengths above zero, all else finite."""
    found = parse_calibration(_text(data), name="f")
    assert all(math.isfinite(value) for value in (*found.intrinsics, *found.camera_offset)), found
    assert found.intrinsics[0] > 0
    assert found.intrinsics[1] > 0


def read_image(data: bytes, folder: Path) -> None:
    """Pixels of the size that the header promised."""
    pixels = decode_image(data, name="f")
    assert pixels.dtype == np.uint8
    assert pixels.ndim == 3
    assert (pixels.shape[1], pixels.shape[0]) == image_size(data, name="f")


def read_depth(data: bytes, folder: Path) -> None:
    """Positive metres or NaN."""
    depth = decode_depth(data, name="f")
    assert not (depth <= 0).any()


def image_seeds(folder: Path) -> list[bytes]:
    """A small photograph in each format that people have."""
    import io

    from PIL import Image

    pixels = np.random.default_rng(0).integers(0, 256, (14, 18, 3), dtype=np.uint8)
    seeds = [encode_png(pixels), encode_jpeg(pixels, quality=80), encode_png(pixels[..., 0])]
    for kind, options in (("GIF", {}), ("BMP", {}), ("WEBP", {}), ("TIFF", {}), ("JPEG", {"exif": _turned()})):
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, kind, **options)
        seeds.append(buffer.getvalue())
    return seeds


def _turned() -> bytes:
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = 6
    return exif.tobytes()


def depth_seeds(folder: Path) -> list[bytes]:
    """A KITTI depth image."""
    return [encode_png(np.arange(200, dtype=np.uint16).reshape(10, 20))]


def manifest_seeds(folder: Path) -> list[bytes]:
    """The manifest of a real store."""
    toy_store(folder / "toy", cars=1, views=2)
    return [(folder / "toy" / "manifest.json").read_bytes()]


def read_damaged_manifest(data: bytes, folder: Path) -> None:
    """Shards named inside the store, counts not negative."""
    (folder / "manifest.json").write_bytes(data)
    manifest = read_manifest(folder)
    assert all(shard.num_patches >= 0 and "/" not in shard.name for shard in manifest.shards), manifest


def store_seeds(folder: Path) -> list[bytes]:
    """The shard of a real store."""
    toy_store(folder / "toy", cars=1, views=2)
    return [next((folder / "toy" / "data").iterdir()).read_bytes()]


class StoreReader:
    """Opens a store whose shard is damaged; the manifest beside it is the sound one."""

    def __init__(self) -> None:
        self._manifest: bytes | None = None

    def __call__(self, data: bytes, folder: Path) -> None:
        """Open, verify and read the first record."""
        if self._manifest is None:
            toy_store(folder / "toy", cars=1, views=2)
            self._manifest = (folder / "toy" / "manifest.json").read_bytes()
        (folder / "data").mkdir(exist_ok=True)
        (folder / "data" / "part-00000.parquet").write_bytes(data)
        (folder / "manifest.json").write_bytes(self._manifest)
        store = open_store(folder)
        problems = store.verify()
        assert all(isinstance(problem, str) for problem in problems)
        for patch_id in store.patch_ids(kept=False)[:2]:
            patch = store.patch(patch_id)
            assert patch.mask.shape == patch.image.shape[:2]


def _tiny() -> tuple[torch.nn.Module, object]:
    config = replace(TINY.model, width=8, depth=2, code_size=4, encoder=replace(TINY.model.encoder, num_features=8))
    torch.manual_seed(0)
    return build_model(config), config


def weight_seeds(folder: Path) -> list[bytes]:
    """Weights of a tiny model."""
    model, config = _tiny()
    save_model(folder / "model", model, config, {"step": 1})
    return [(folder / "model" / "model.safetensors").read_bytes()]


def read_weights(data: bytes, folder: Path) -> None:
    """The description names the damaged file's own checksum, so that the tensors are looked at."""
    import hashlib

    if not (folder / "model.json").exists():
        model, config = _tiny()
        save_model(folder, model, config, {"step": 1})
    description = json.loads((folder / "model.json").read_text())
    description["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / "model.json").write_text(json.dumps(description))
    (folder / "model.safetensors").write_bytes(data)
    model = load_model(folder)
    assert all(tensor.dtype.is_floating_point for tensor in model.state_dict().values())


def description_seeds(folder: Path) -> list[bytes]:
    """`model.json` of a tiny model."""
    model, config = _tiny()
    save_model(folder / "model", model, config, {"step": 1})
    return [(folder / "model" / "model.json").read_bytes()]


def read_description(data: bytes, folder: Path) -> None:
    """A config that a model could be built from."""
    (folder / "model.json").write_bytes(data)
    assert len(describe_model(folder).sha256) > 0


def state_seeds(folder: Path) -> list[bytes]:
    """What a training resumes from."""
    model, _ = _tiny()
    optimizer = torch.optim.RAdam(model.parameters())
    sum(parameter.sum() for parameter in model.parameters()).backward()
    optimizer.step()
    state = TrainingState.of(model, optimizer, step=3, seconds=1.5, starts_from="random weights")
    folder.mkdir(parents=True, exist_ok=True)
    save_state(folder, state)
    return [(folder / STATE).read_bytes()]


def read_state(data: bytes, folder: Path) -> None:
    """Step and seconds sound, tensors that fit model and optimiser, which can go on."""
    (folder / STATE).write_bytes(data)
    state = load_state(folder)
    assert state.step >= 0
    assert 0 <= state.seconds < math.inf
    model, _ = _tiny()
    optimizer = torch.optim.RAdam(model.parameters())
    state.into(model, optimizer)
    sum(parameter.sum() for parameter in model.parameters()).backward()
    optimizer.step()


def read_result_rows(data: bytes, folder: Path) -> None:
    """Finite scores."""
    (folder / "rows.jsonl").write_bytes(data)
    for row in read_rows(folder / "rows.jsonl"):
        assert row.psnr is None or math.isfinite(row.psnr)


def read_training_log(data: bytes, folder: Path) -> None:
    """A list of objects."""
    (folder / "log.jsonl").write_bytes(data)
    assert all(isinstance(row, dict) for row in read_log(folder / "log.jsonl"))


def read_any_json(data: bytes, folder: Path) -> None:
    """Whatever JSON holds."""
    (folder / "f.json").write_bytes(data)
    read_json(folder / "f.json")


def legacy_seeds(folder: Path) -> list[bytes]:
    """The authors' json of two subsets."""
    return [write_subset(folder / subset, subset).read_bytes() for subset in ("km", "ko")]


def read_legacy(data: bytes, folder: Path) -> None:
    """Records of a damaged json, its pictures sound: a patch, or the problem with it in words."""
    if not (folder / "patch").exists():
        for subset in ("km", "ko"):
            write_subset(folder, subset)
    (folder / "km.json").write_bytes(data)
    source = open_legacy(folder / "km.json")
    job = LegacyJob(source.folder, "exact")
    for result in map(job, source.items(frozenset())):
        assert bool(result.records) != bool(result.problems), result
        for record in result.records:
            assert not [problem for problem in record_problems(record) if "focal" in problem or "finite" in problem]


ROW = {
    **{name: "a" for name in ("method", "protocol", "split", "instance_id", "patch_id", "input_patch_id")},
    **{"psnr": 20.5, "psnr_mask": 19.0, "ssim": 0.5, "ssim_mask": 0.4, "lpips": None, "mask_iou": 0.9},
    **{"seed": 0, "steps": 10, "data_sha256": "0" * 64, "checkpoint_sha256": "1" * 64},
}
LOG = b"".join(json.dumps({"step": i, "loss": 0.1 * i, "psnr": 10.0 + i}).encode() + b"\n" for i in (20, 40, 60))

TARGETS = {
    "labels": Target(lambda folder: [LABELS], read_labels),
    "tracks": Target(lambda folder: [TRACKS], read_tracks),
    "calibration": Target(lambda folder: [CALIBRATION], read_calibration),
    "image": Target(image_seeds, read_image),
    "depth": Target(depth_seeds, read_depth),
    "manifest": Target(manifest_seeds, read_damaged_manifest),
    "store": Target(store_seeds, StoreReader()),
    "weights": Target(weight_seeds, read_weights),
    "description": Target(description_seeds, read_description),
    "state": Target(state_seeds, read_state),
    "rows": Target(lambda folder: [json.dumps(ROW).encode() + b"\n"], read_result_rows),
    "log": Target(lambda folder: [LOG], read_training_log),
    "json": Target(manifest_seeds, read_any_json),
    "legacy": Target(legacy_seeds, read_legacy),
}

warnings.simplefilter("error", RuntimeWarning)
