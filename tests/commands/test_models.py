"""`carstudio models`: the table, downloads from a hub on this machine, folders checked by loading them."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from transformers import ResNetConfig, ResNetModel

from carstudio.cli import run
from carstudio.commands.models import option_of_folder
from carstudio.errors import InputError, StorageError
from carstudio.perception import downloads
from carstudio.perception.downloads import download
from carstudio.perception.sam import SamSegmenter
from carstudio.perception.specs import make_segmenter
from carstudio.perception.weights import DEFAULT_DETECTOR, DEFAULT_SAM, DEFAULT_SAM2, KNOWN_MODELS, RESNET34, full_name
from commands.fake_hub import Hub, serve
from perception.tiny_hub import save_dfine, save_sam, save_sam2


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    """It has SAM under its real name, small, with files of other programs beside it."""
    folder = tmp_path / "hub" / "facebook" / "sam-vit-base"
    folder.mkdir(parents=True)
    save_sam(folder)
    for name in ("pytorch_model.bin", "tf_model.h5", "README.md", ".gitattributes"):
        (folder / name).write_bytes(b"not ours")
    with serve(tmp_path / "hub", tmp_path / "cache", monkeypatch) as served:
        yield served


def test_a_downloaded_model_is_here_and_works(hub: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models", "list", "--json"]) == 0
    assert not any(model["is_here"] for model in json.loads(capsys.readouterr().out)["models"])
    assert run(["models", "download", "sam-vit-base"]) == 0
    assert "--segmenter sam:facebook/sam-vit-base" in capsys.readouterr().out
    assert sorted(hub.sent) == ["config.json", "model.safetensors", "preprocessor_config.json"]
    assert run(["models", "list", "--json"]) == 0
    here = [model["name"] for model in json.loads(capsys.readouterr().out)["models"] if model["is_here"]]
    assert here == ["facebook/sam-vit-base"]
    hub.sent.clear()
    assert run(["models", "download", "sam-vit-base"]) == 0
    assert make_segmenter("sam:facebook/sam-vit-base") == SamSegmenter(name="facebook/sam-vit-base")
    assert hub.sent == []  # nothing is fetched twice


def test_a_model_is_carried_in_a_folder(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out" / "sam"
    assert run(["models", "download", "facebook/sam-vit-base", "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(hub.sent)
    assert sorted(hub.sent) == ["config.json", "model.safetensors", "preprocessor_config.json"]
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert make_segmenter(f"sam:{out}") == SamSegmenter(name=str(out))


def test_several_models_get_a_folder_each(hub: Hub, tmp_path: Path) -> None:
    other = hub.root / "someone" / "detector"
    other.mkdir(parents=True)
    save_dfine(other)
    out = tmp_path / "out"
    assert run(["models", "download", "sam-vit-base", "someone/detector", "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["detector", "sam-vit-base"]
    assert run(["models", "list", str(out / "detector"), str(out / "sam-vit-base")]) == 0


def test_progress_is_told_in_megabytes(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "_MEGABYTE", 1000)
    told: list[tuple[str, int, int, str]] = []
    fetched = download("facebook/sam-vit-base", report=lambda *what: told.append(what))
    names, done, totals, notes = (list(column) for column in zip(*told, strict=True))
    assert set(names) == {"facebook/sam-vit-base"}
    assert set(totals) == {fetched.num_bytes // 1000}
    assert done == sorted(done)
    assert done[-1] == totals[-1]
    assert set(notes) == {"MB"}


def test_an_interrupted_download_says_how_to_go_on(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.sleep", lambda _: None)  # the client waits between its attempts
    hub.cut = 1000
    with pytest.raises(InputError, match=r"model.safetensors stopped in the middle .* goes on where it was"):
        download("facebook/sam-vit-base", tmp_path / "out")
    hub.cut = None
    download("facebook/sam-vit-base", tmp_path / "out")
    assert option_of_folder(tmp_path / "out") == f"--segmenter sam:{tmp_path / 'out'}"


def test_no_such_model(hub: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models", "download", "nobody/nothing"]) == 2
    assert f"nobody/nothing: no such model on {hub.url}" in capsys.readouterr().err


def test_a_model_of_another_program(hub: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    folder = hub.root / "someone" / "else"
    folder.mkdir(parents=True)
    (folder / "weights.onnx").write_bytes(b"x")
    assert run(["models", "download", "someone/else"]) == 2
    assert "expected a model as save_pretrained writes it" in capsys.readouterr().err


def test_too_little_room(hub: Hub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = downloads.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(downloads.shutil, "disk_usage", lambda _: usage._replace(free=100))
    with pytest.raises(StorageError, match=r"facebook/sam-vit-base takes 0.0 GB, 0.0 GB are free"):
        download("facebook/sam-vit-base", tmp_path / "out")


def test_offline_is_told_with_the_way_out(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    assert run(["models", "download", "sam-vit-huge"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    for part in ("facebook/sam-vit-huge", "HF_HUB_OFFLINE is set", "--out FOLDER", "HTTPS_PROXY", "HF_ENDPOINT"):
        assert part in told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["download"], "download needs a name"),
        (["download", "nonsense"], "expected OWNER/MODEL as on the hub, or one of dfine-medium-obj2coco"),
        (["list", "--out", "x"], "--out is for download"),
        (["list", "/no/such/folder"], "/no/such/folder: no config.json"),
        (["convert"], "expected dd3d CHECKPOINT.pth --out FOLDER, found nothing without --out"),
        (["convert", "dd3d", "a.pth"], "expected dd3d CHECKPOINT.pth --out FOLDER, found dd3d a.pth without --out"),
        (["convert", "yolo", "a.pth", "--out", "x"], "expected dd3d CHECKPOINT.pth --out FOLDER, found yolo a.pth"),
    ],
)
def test_wrong_use_is_told(arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models", *arguments]) == 2
    assert told in capsys.readouterr().err


def test_the_list_names_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["models", "list"]) == 0
    shown = capsys.readouterr().out
    for model in KNOWN_MODELS:
        assert model.name in shown  # whole: to be copied
        assert f"{model.megabytes} MB" in shown


def test_defaults_are_known() -> None:
    names = [model.name for model in KNOWN_MODELS]
    assert {DEFAULT_DETECTOR, DEFAULT_SAM, DEFAULT_SAM2, RESNET34} <= set(names)
    assert len({model.short_name for model in KNOWN_MODELS}) == len(names)
    assert all(full_name(model.short_name) == model.name for model in KNOWN_MODELS)
    assert replace(KNOWN_MODELS[0], name="a/b").short_name == "b"


def test_folders_are_checked_by_loading_them(tmp_path: Path) -> None:
    for name in ("sam2", "resnet"):
        (tmp_path / name).mkdir()
    save_sam2(tmp_path / "sam2", is_video=True)
    assert option_of_folder(tmp_path / "sam2") == f"--segmenter sam2:{tmp_path / 'sam2'}"
    config = ResNetConfig(depths=[3, 4, 6, 3], hidden_sizes=[64, 128, 256, 512], layer_type="basic")
    ResNetModel(config).save_pretrained(tmp_path / "resnet")
    assert option_of_folder(tmp_path / "resnet") == f"--model.encoder.pretrained {tmp_path / 'resnet'}"
    (tmp_path / "sam2" / "model.safetensors").write_bytes(b"half")
    with pytest.raises(InputError, match="sam2"):
        option_of_folder(tmp_path / "sam2")
