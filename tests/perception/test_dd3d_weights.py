"""Checkpoints made ours: what is wrong with one is named, nothing in it is run. A network whose boxes are known."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from carstudio.cli import run
from carstudio.commands.models import option_of_folder
from carstudio.dataset.known_boxes import make_box_estimator
from carstudio.dataset.store import open_store
from carstudio.errors import InputError
from carstudio.perception.coco import read_results
from carstudio.perception.dd3d.adapter import Dd3dEstimator, open_dd3d
from carstudio.perception.dd3d.model import DD3D, KITTI_CLASSES, DD3DConfig
from carstudio.perception.dd3d.weights import check_weights, convert, load_dd3d, read_checkpoint


def states(backbone: Any = "dla34") -> dict[str, torch.Tensor]:
    """All weights 0 but norms, which change nothing, and what is learned per level: a file of kilobytes."""
    with torch.device("meta"):
        shapes = DD3D(DD3DConfig(backbone)).state_dict()
    ones = ("running_var", "norm.weight", "scale")
    weights = {key: torch.full((), float(key.endswith(ones))).expand(value.shape) for key, value in shapes.items()}
    return {key: value.long() if "num_batches" in key else value for key, value in weights.items()}


def saved(path: Path, weights: object) -> Path:
    torch.save(weights, path)
    return path


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """As training leaves it, with more than the weights."""
    return saved(tmp_path / "model_final.pth", {"model": states(), "iteration": 7, "optimizer": {"state": {}}})


@pytest.mark.parametrize("backbone", ["dla34", "v2-99"])
def test_every_key_is_there_as_in_the_original(dd3d_data: Path, backbone: Any) -> None:
    entries = json.loads((dd3d_data / f"keys_{backbone.replace('2-', '')}.json").read_text())
    with torch.device("meta"):
        network = DD3D(DD3DConfig(backbone))
    ours = {key: (list(value.shape), str(value.dtype)) for key, value in network.state_dict().items()}
    assert list(ours.items()) == [(e["key"], (e["shape"], f"torch.{e['dtype']}")) for e in entries]
    parameters = {e["key"] for e in entries if e["kind"] == "parameter"}
    assert {name for name, _ in network.named_parameters()} == parameters


def test_a_checkpoint_becomes_a_folder_and_is_the_same_network(checkpoint: Path, tmp_path: Path) -> None:
    weights = states() | {"fcos2d_head.cls_logits.bias": torch.arange(5.0)}
    made = convert(saved(checkpoint, {"model": weights}), tmp_path / "out")
    assert (made.backbone, made.folder) == ("dla34", tmp_path / "out")
    assert sorted(path.name for path in made.folder.iterdir()) == ["config.json", "model.safetensors"]
    loaded = load_dd3d(made.folder).state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in weights.items())
    assert len(loaded) == len(weights) == 560
    assert option_of_folder(made.folder) == f"--box3d dd3d:{made.folder}"
    assert make_box_estimator(f"dd3d:{made.folder}") == Dd3dEstimator(folder=made.folder)


def test_wrappers_of_training_are_taken_off(tmp_path: Path) -> None:
    wrapped = {f"module.{key}": value for key, value in states().items()}
    assert list(read_checkpoint(saved(tmp_path / "a.pth", wrapped))) == list(states())


def test_counters_of_training_may_be_absent(tmp_path: Path) -> None:
    weights = {key: value for key, value in states().items() if "num_batches" not in key}
    convert(saved(tmp_path / "a.pth", weights), tmp_path / "out")
    assert int(load_dd3d(tmp_path / "out").state_dict()["fcos2d_head.cls_tower.0.norm.0.num_batches_tracked"]) == 0


FIRST = "backbone.bottom_up.base_layer.weight"


def without(key: str) -> dict[str, torch.Tensor]:
    return {name: value for name, value in states().items() if name != key}


@pytest.mark.parametrize(
    ("weights", "told"),
    [
        (lambda: without("backbone.top_block.p6.bias"), r"missing 1 \(backbone.top_block.p6.bias\), unexpected 0"),
        (lambda: {FIRST: torch.zeros(16, 3, 7, 7)}, r"missing 519 \(pixel_mean, .* \.\.\.\), unexpected 0"),
        (lambda: states() | {"fcos2d_head.nonsense": torch.zeros(1)}, r"unexpected 1 \(fcos2d_head.nonsense\)"),
        (lambda: states() | {"pixel_std": torch.ones(3)}, r"pixel_std must have shape \[3, 1, 1\], has \[3\]"),
        (lambda: states() | {"pixel_std": torch.full((3, 1, 1), torch.nan)}, "pixel_std must hold finite numbers"),
        (lambda: states() | {"pixel_std": torch.ones(3, 1, 1).int()}, "pixel_std must hold finite numbers of torch.fl"),
        (lambda: states() | {"fcos2d_head.cls_logits.weight": torch.zeros(10, 256, 3, 3)}, "found one of 10"),
        (lambda: {"conv1.weight": torch.zeros(3)}, r"expected a DD3D with DLA-34 or V2-99 .* found \['conv1.weight'\]"),
        (lambda: {"model": {}}, r"expected a dictionary of weights, or one below 'model', found keys \['model'\]"),
        (lambda: torch.zeros(3), "expected a dictionary of weights, .* found Tensor"),
        (lambda: {"model": {"a": "text"}}, "expected a tensor for every key, found 'a': str"),
    ],
)
def test_a_wrong_checkpoint_is_told(tmp_path: Path, weights: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        convert(saved(tmp_path / "a.pth", weights()), tmp_path / "out")
    assert not (tmp_path / "out" / "config.json").exists()


class Trap:
    """Its pickle makes a folder when it is read by pickle itself."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.mkdir, (self.folder,))


def test_a_pickled_object_is_refused_and_not_run(tmp_path: Path) -> None:
    trap = tmp_path / "trap"
    file = saved(tmp_path / "a.pth", {"model": states(), "extra": Trap(trap)})
    with pytest.raises(InputError, match="which is not run"):
        convert(file, tmp_path / "out")
    assert not trap.exists()
    torch.load(file, weights_only=False)
    assert trap.exists()  # it would have


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", None])
def test_no_checkpoint_at_all(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "a.pth").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.pth: "):
        convert(tmp_path / "a.pth", tmp_path / "out")
    with pytest.raises(InputError, match="cannot be read"):
        read_checkpoint(tmp_path)


def test_a_damaged_folder_is_told(checkpoint: Path, tmp_path: Path) -> None:
    folder = convert(checkpoint, tmp_path / "out").folder
    good = json.loads((folder / "config.json").read_text())
    for change, told in (
        ({"backbone": "resnet"}, "found 1, 'resnet'"),
        ({"format_version": 2}, "found 2, 'dla34'"),
        ({"model_type": "sam"}, "holds another model"),
        ({"sha256": "0" * 64}, "sha256 differs"),
        ({"backbone": "v2-99"}, "not the weights of this DD3D: missing"),
    ):
        (folder / "config.json").write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=told):
            make_box_estimator(f"dd3d:{folder}")
    (folder / "config.json").unlink()
    with pytest.raises(InputError, match="models convert dd3d"):
        make_box_estimator(f"dd3d:{folder}")


def test_the_larger_backbones_weights_pass() -> None:
    with torch.device("meta"):
        expected = DD3D(DD3DConfig("v2-99")).state_dict()
    check_weights(expected, states("v2-99"), name="ours")


LEVEL, SIDE, DEPTH = 3, 1.0, 30.0


def one_car_per_cell() -> dict[str, torch.Tensor]:
    """Every cell says: a car of its level's depth, upright, seen straight ahead; boxes grow with the level."""
    weights = states()
    kinds = len(KITTI_CLASSES)
    logits = torch.full((kinds,), -9.0)
    logits[0] = 6.0
    weights |= {
        "pixel_std": torch.ones(3, 1, 1),
        "fcos2d_head.cls_logits.bias": logits,
        "fcos2d_head.centerness.bias": torch.full((1,), 5.0),
        "fcos2d_head.box2d_reg.bias": torch.ones(4),
        "fcos3d_head.box3d_conf.0.bias": torch.full((kinds,), 2.0),
        # allocentric: x (front) to the camera's right, z (up) against its y
        "fcos3d_head.box3d_quat.0.bias": torch.tensor([math.sqrt(0.5), math.sqrt(0.5), 0, 0]).repeat_interleave(kinds),
    }
    for level in range(5):
        weights[f"fcos2d_head.scales_box2d_reg.{level}.scale"] = torch.tensor([8.0 * 2**level])
        weights[f"fcos3d_head.offsets_depth.{level}.bias"] = torch.tensor([DEPTH + level])
    return weights


def test_the_whole_way_from_checkpoint_to_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`models convert`, `models list`, `build photos --box3d dd3d:`: each detection gets the box of its place."""
    file = saved(tmp_path / "dd3d.pth", {"model": one_car_per_cell()})
    out = tmp_path / "dd3d"
    assert run(["models", "convert", "dd3d", str(file), "--out", str(out)]) == 0
    assert f"--box3d dd3d:{out}" in capsys.readouterr().out
    photos = tmp_path / "photos"
    photos.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (192, 192, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(photos / "a.png")
    # The network sees it twice as large. A cell of level 3 (stride 64) at column 4, row 3: (256, 192) px there,
    # (128, 96) here, +- 64 px there, +- 32 px here. The other box is of no cell's size.
    boxes = [[128 - 33, 96 - 31, 64, 64], [20, 20, 12, 90]]
    content = [{"image_id": "a.png", "category_id": 3, "bbox": box, "score": 0.8} for box in boxes]
    (tmp_path / "r.json").write_text(json.dumps(content))
    read_results.cache_clear()
    arguments = [
        "--root",
        str(photos),
        "--out",
        str(tmp_path / "store"),
        "--detector",
        f"precomputed:{tmp_path / 'r.json'}",
    ]
    camera = ["--camera", "300,320,120,100", "--workers", "1", "--no-report", "--quiet"]
    assert run(["build", "photos", *arguments, "--box3d", f"dd3d:{out}", *camera]) == 0
    joined, alone = sorted(open_store(tmp_path / "store").records(), key=lambda record: record.box_center is None)
    assert (alone.box_center, alone.score_3d, alone.score_2d) == (None, None, 0.8)
    z = (DEPTH + LEVEL) / 500 / math.hypot(1 / 600, 1 / 640)
    assert joined.box_center == pytest.approx(((128 - 120) / 300 * z, (96 - 100) / 320 * z, z), rel=1e-5)
    width, length, height = KITTI_CLASSES["Car"]
    assert joined.box_size == pytest.approx((length, height, width), rel=1e-5)
    assert joined.box_yaw == pytest.approx(math.atan2(8, 300), abs=1e-5)  # turned with the line of sight
    score_2d = math.sqrt(1 / (1 + math.exp(-6.0)) / (1 + math.exp(-5.0)))
    assert (joined.score_2d, joined.score_3d) == (0.8, pytest.approx(score_2d / (1 + math.exp(-2.0)), rel=1e-5))
    open_dd3d.cache_clear()


def test_it_could_be_trained() -> None:
    """Raw outputs are there before decoding, and gradients reach every parameter."""
    torch.manual_seed(0)
    network = DD3D(DD3DConfig("dla34")).train()
    outputs = network(torch.randn(2, 3, 128, 128))
    loss = torch.stack([getattr(level, name).square().mean() for level in outputs for name in vars(level)]).sum()
    loss.backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
    moving = network.get_buffer("fcos2d_head.cls_tower.0.norm.0.running_mean")
    frozen = network.get_buffer("fcos3d_head.box3d_tower.0.norm.0.running_mean")
    assert float(moving.abs().max()) > 0 == float(frozen.abs().max())


def test_photos_of_different_sizes_are_padded_to_one() -> None:
    """Right and below, with what a mean pixel becomes: 0."""
    network = DD3D(DD3DConfig("dla34"))
    one = torch.full((3, 130, 100), 200, dtype=torch.uint8)
    other = torch.zeros(3, 90, 300, dtype=torch.uint8)
    pixels = network.prepare([one, other])
    assert pixels.shape == (2, 3, 256, 384)  # multiples of 128
    means, deviations = (103.53, 116.28, 123.675), (57.375, 57.12, 58.395)
    for channel, (mean, deviation) in enumerate(zip(means, deviations, strict=True)):
        assert pixels[0, channel, :130, :100].unique().tolist() == pytest.approx([(200 - mean) / deviation])
        assert pixels[1, channel, :90, :300].unique().tolist() == pytest.approx([-mean / deviation])
    assert float(pixels[0, :, 130:].abs().max()) == float(pixels[0, :, :, 100:].abs().max()) == 0
    assert float(pixels[1, :, 90:].abs().max()) == float(pixels[1, :, :, 300:].abs().max()) == 0
