"""Merging: the same patches, bytes and verdicts as in the stores; what contradicts itself is refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from carstudio.cli import run
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.merge import merge_stores
from carstudio.dataset.store import StoreWriter, open_store
from carstudio.errors import InputError
from dataset.made_up_patches import made_up_record, made_up_store


def two_stores(tmp_path: Path) -> tuple[Path, Path]:
    """Patches 0 to 9, and 8 to 14 of another source and licence: 8 and 9 are in both, equal."""
    others = [made_up_record(i, source="photos", licence="CC-BY-4.0") for i in range(10, 15)]
    made_up_store(tmp_path / "a", map(made_up_record, range(10)))
    made_up_store(tmp_path / "b", [made_up_record(8), made_up_record(9), *others], source="photos")
    return tmp_path / "a", tmp_path / "b"


def test_nothing_is_lost_or_changed(tmp_path: Path) -> None:
    a, b = two_stores(tmp_path)
    summary = merge_stores([a, b], tmp_path / "c")
    merged = open_store(tmp_path / "c")
    expected = [
        *open_store(a).records(),
        *(record for record in open_store(b).records() if record.patch_id > "p-00009"),
    ]
    assert list(merged.records()) == expected
    verdicts = {verdict.patch_id: verdict for path in (a, b) for verdict in open_store(path).verdicts()}
    assert merged.verdicts() == [verdicts[record.patch_id] for record in expected]
    assert (summary.patches, summary.repeated, summary.kept) == (15, 2, merged.info()["kept"])
    assert merged.manifest.sources == ("made-up", "photos")
    assert merged.info()["licences"] == {"CC-BY-4.0": 5, "CC0-1.0": 10}
    assert merged.split_names() == ["instance", "released-patch", "view"]
    assert merged.verify() == []
    merge_stores([a, b], tmp_path / "d")
    assert open_store(tmp_path / "d").data_sha256 == merged.data_sha256


def test_an_interrupted_merge_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = two_stores(tmp_path)
    merge_stores([a, b], tmp_path / "whole")

    def fail(store: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("carstudio.dataset.merge.write_splits", fail)
    with pytest.raises(KeyboardInterrupt):
        merge_stores([a, b], tmp_path / "c")
    assert not open_store(tmp_path / "c").manifest.is_finished
    monkeypatch.undo()
    merge_stores([a, b], tmp_path / "c")
    assert open_store(tmp_path / "c").data_sha256 == open_store(tmp_path / "whole").data_sha256


def test_rows_that_differ_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    a, b = two_stores(tmp_path)
    made_up_store(tmp_path / "x", [replace(made_up_record(3), fx=701.0, licence="other")])
    with pytest.raises(InputError, match=r"patch p-00003: .*a and .*x both have it, and they differ in fx, licence"):
        merge_stores([a, b, tmp_path / "x"], tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_verdicts_that_differ_are_refused(tmp_path: Path) -> None:
    a, _ = two_stores(tmp_path)
    made_up_store(tmp_path / "x", [made_up_record(3)], recipe=FilterRecipe(depth_m=1.0))
    with pytest.raises(InputError, match=r"judge it differently \(kept, .*refilter"):
        merge_stores([a, tmp_path / "x"], tmp_path / "c")


def test_unjudged_patches_stay_unjudged(tmp_path: Path) -> None:
    a, _ = two_stores(tmp_path)
    with StoreWriter(tmp_path / "x", source="made-up") as writer:
        writer.append(made_up_record(40))
    merge_stores([tmp_path / "x", a], tmp_path / "c")
    assert open_store(tmp_path / "c").info()["unjudged"] == 1


def test_what_cannot_be_merged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = two_stores(tmp_path)
    for arguments, message in (
        ([str(a), "--out", str(tmp_path / "c")], "two stores or more, found 1"),
        ([str(a), str(b), "--out", str(a)], "is one of the stores to merge"),
        ([str(a), str(tmp_path / "none"), "--out", str(tmp_path / "c")], "no CarPatch3D store"),
    ):
        assert run(["dataset", "merge", *arguments]) == 2
        assert message in capsys.readouterr().err
    assert run(["dataset", "merge", str(a), str(b), "--out", str(tmp_path / "c"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["patches"] == 15
    assert run(["dataset", "merge", str(a), str(b), "--out", str(tmp_path / "c")]) == 2
    assert "already holds a finished store" in capsys.readouterr().err
