"""The dataset card: its header is YAML that names the data, its tables are the store's counts, no path is told."""

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from carstudio.cli import run
from carstudio.dataset.card import card_text, hub_licence
from carstudio.dataset.merge import merge_stores
from carstudio.dataset.runs import write_run
from carstudio.dataset.store import open_store
from dataset.made_up_patches import made_up_record, made_up_store

KITTI = "CC-BY-NC-SA-3.0 (KITTI)"


def header(text: str) -> dict[str, object]:
    found: dict[str, object] = yaml.safe_load(text.split("---\n")[1])
    return found


def test_the_header_names_files_that_are_there(tmp_path: Path) -> None:
    store = made_up_store(tmp_path / "my cars", map(made_up_record, range(9)))
    found = header(card_text(store))
    assert (found["license"], found["size_categories"]) == ("cc0-1.0", ["n<1K"])
    configs = {config["config_name"]: config["data_files"] for config in found["configs"]}  # type: ignore[attr-defined]
    assert configs.keys() == {"patches", "verdicts", "split-instance", "split-view", "split-released-patch"}
    for pattern in configs.values():
        assert sum(pq.read_metadata(path).num_rows for path in store.path.glob(pattern)) > 0


def test_the_ledger_counts_sources_and_licences(tmp_path: Path) -> None:
    made_up_store(tmp_path / "a", (made_up_record(i, source="kitti-mot", licence=KITTI) for i in range(6)))
    made_up_store(tmp_path / "b", (made_up_record(i, licence="a|b\n# c") for i in range(6, 9)))
    write_run(tmp_path / "a", {"segmenter": "onnx:/home/somebody/net.onnx", "root": "/home/somebody/kitti"})
    merge_stores([tmp_path / "a", tmp_path / "b"], tmp_path / "c")
    text = card_text(open_store(tmp_path / "c"), title="Two `sources`")
    assert header(text)["license"] == "other"
    kept = sum(verdict.is_kept for verdict in open_store(tmp_path / "a").verdicts())
    assert f"| kitti-mot | 6 | {kept} | {KITTI} |" in text
    assert "| made-up | 3 | " in text
    assert "a\\|b # c" in text
    assert "Not for commercial use" in text
    assert "`onnx:net.onnx`" in text
    assert "somebody" not in text
    assert "# Two 'sources'\n" in text
    assert str(tmp_path) not in text


def test_no_warning_without_kitti(tmp_path: Path) -> None:
    text = card_text(made_up_store(tmp_path / "s", map(made_up_record, range(3))))
    assert "commercial" not in text
    assert "how masks and boxes were made is not recorded" in text


@pytest.mark.parametrize(
    ("licences", "name"),
    [
        ({KITTI}, "cc-by-nc-sa-3.0"),
        ({"CC-BY-4.0"}, "cc-by-4.0"),
        ({"CC-BY-NC-4.0"}, "cc-by-nc-4.0"),
        ({"proprietary"}, "other"),
        ({"MITRE"}, "other"),
        ({"MIT", "CC0-1.0"}, "other"),
        (set(), "other"),
    ],
)
def test_licences_as_the_hub_names_them(licences: set[str], name: str) -> None:
    assert hub_licence(licences) == name


def test_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = made_up_store(tmp_path / "s", map(made_up_record, range(3)))
    assert run(["dataset", "card", str(store.path)]) == 0
    assert (store.path / "README.md").read_text().startswith("---\nlicense: cc0-1.0\n")
    assert run(["dataset", "card", str(store.path)]) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert run(["dataset", "card", str(store.path), "--force", "--title", "Cars"]) == 0
    assert "# Cars\n" in (store.path / "README.md").read_text()
    assert open_store(store.path).verify() == []


def test_info_counts_cameras_boxes_and_masks(tmp_path: Path) -> None:
    records = [made_up_record(i, camera_source="exif:28" if i else "calib:P2", mask=None) for i in range(4)]
    info = made_up_store(tmp_path / "s", records).info()
    assert info["cameras"] == {"calib:P2": 1, "exif:28": 3}
    assert info["with_mask"] == {"patches": 0, "share": 0.0}
    assert info["with_box3d"] == {"patches": 4, "share": 1.0}
