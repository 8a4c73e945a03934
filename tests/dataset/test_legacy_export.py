"""A store -> the authors' files: theirs come back byte by byte, others say the same geometry."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from carstudio.cli import run
from carstudio.commands.dataset import refilter
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.legacy_json import stream
from carstudio.dataset.legacy_json.exporter import UNFINISHED, export_legacy
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.dataset.store import PatchStore, StoreWriter, open_store
from carstudio.dataset.verdicts import Verdict
from carstudio.errors import InputError
from carstudio.files import is_partial
from carstudio.images import encode_jpeg, encode_png
from dataset.authors_files import DATASET_NAMES, write_all, write_subset
from oracles import released_formulas


def import_files(root: Path, out: Path, **changes: Any) -> PatchStore:
    assert build(BuildConfig(source="legacy-json", root=root, out=out, workers=1, **changes)).problems == ()
    return open_store(out)


def tree(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in sorted(path.rglob("*")) if file.is_file()}


@pytest.fixture(scope="module")
def authors(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_all(tmp_path_factory.mktemp("authors"))


@pytest.fixture(scope="module")
def imported(authors: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return import_files(authors, tmp_path_factory.mktemp("imported") / "store").path


def test_the_authors_files_come_back_byte_by_byte(authors: Path, imported: Path, tmp_path: Path) -> None:
    summary = export_legacy(open_store(imported), tmp_path / "out")
    assert tree(tmp_path / "out") == tree(authors)
    assert summary.files == {"dv.json": 3, "km.json": 4, "ko.json": 3, "ns.json": 3, "vk.json": 3}
    assert summary.left_out == {}
    assert b"1.50e+2" in tree(tmp_path / "out")["km.json"]  # numbers that a reader and writer of JSON would change
    assert b'"yaw": -0.0,' in tree(tmp_path / "out")["km.json"]


@pytest.mark.parametrize("chunk", [7, 64])
def test_where_the_reader_cuts_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunk: int) -> None:
    root = write_subset(tmp_path / "in", "dv").parent
    monkeypatch.setattr(stream, "_CHUNK", chunk)
    monkeypatch.setattr(stream, "MAX_RECORD", 2000)
    export_legacy(import_files(root, tmp_path / "store"), tmp_path / "out")
    assert tree(tmp_path / "out") == tree(root)


@pytest.mark.parametrize("rejected", [{0}, {1}, {3}, {0, 3}, {0, 1, 2}])
def test_what_is_kept_is_still_the_authors_json(authors: Path, tmp_path: Path, rejected: set[int]) -> None:
    store = import_files(authors, tmp_path / "store", subset="km")
    ids = store.patch_ids()
    store.write_verdicts([Verdict(name, index not in rejected, "x") for index, name in enumerate(ids)])
    export_legacy(open_store(store.path), tmp_path / "out")
    was, now = (json.loads((folder / "km.json").read_text(encoding="utf-8")) for folder in (authors, tmp_path / "out"))
    assert now["instances"] == [value for index, value in enumerate(was["instances"]) if index not in rejected]
    assert list(now) == list(was)
    assert len(list((tmp_path / "out" / "patch").iterdir())) == 4 - len(rejected)
    export_legacy(open_store(store.path), tmp_path / "all", patches="all")
    assert (tmp_path / "all" / "km.json").read_bytes() == (authors / "km.json").read_bytes()


@pytest.mark.parametrize("broken", [0, 1, 3])
def test_without_a_broken_record_the_rest_comes_back(authors: Path, tmp_path: Path, broken: int) -> None:
    text = (authors / "km.json").read_text(encoding="utf-8")
    values = json.loads(text)["instances"]
    stem = values[broken]["patch"]
    (tmp_path / "in").mkdir()
    for folder in ("patch", "mask"):
        (tmp_path / "in" / folder).symlink_to(authors / folder)
    (tmp_path / "in" / "km.json").write_text(text.replace(stem, "patch/none.png"), encoding="utf-8")
    config = BuildConfig(source="legacy-json", root=tmp_path / "in", out=tmp_path / "store", workers=1)
    assert build(config).candidates == 0  # links lead out of the folder
    for folder in ("patch", "mask"):
        (tmp_path / "in" / folder).unlink()
        (tmp_path / "in" / folder).mkdir()
        for file in (authors / folder).iterdir():
            (tmp_path / "in" / folder / file.name).hardlink_to(file)
    assert len(build(replace(config, out=tmp_path / "t")).problems) == 1
    export_legacy(open_store(tmp_path / "t"), tmp_path / "out")
    now = json.loads((tmp_path / "out" / "km.json").read_text(encoding="utf-8"))
    assert now["instances"] == [value for index, value in enumerate(values) if index != broken]
    assert now["dataset_name"] == "km"


def made_record(index: int, **changes: Any) -> PatchRecord:
    """A car of KITTI's tracking frames, as `kitti-mot` would write it, with a JPEG and a three-valued mask."""
    rng = np.random.default_rng(index)
    image = encode_jpeg(rng.integers(0, 256, (30, 50, 3), dtype=np.uint8), quality=90)
    mask = rng.choice([int(value) for value in MaskValue], (30, 50)).astype(np.uint8)
    record = PatchRecord(
        patch_id=f"km-0003-{index:06d}-012",
        instance_id="km-0003-012",
        frame_id=f"0003-{index:06d}",
        source="kitti-mot",
        image=image,
        mask=encode_png(mask),
        frame_path=f"image_02/0003/{index:06d}.png",
        frame_width=1242,
        frame_height=375,
        crop_x0=600,
        crop_y0=170,
        crop_width=50,
        crop_height=30,
        fx=721.5377,
        fy=721.5377,
        cx=609.5593,
        cy=172.854,
        camera_offset=(0.05984926, -0.00035793, 0.002745884),
        camera_source="calib:P2",
        box2d=(600.7, 170.2, 649.999, 199.01),
        box_center=(0.1, 1.0 / 3.0, 20.0 + index),
        box_size=(4.2, 1.5, 1.8),
        box_yaw=-1.57,
        mask_ratio=0.7,
        licence="CC0-1.0",
        sha256=hashlib.sha256(image).hexdigest(),
        extra='{"type": "Car"}',
    )
    return replace(record, **changes)


def write_store(path: Path, *records: PatchRecord) -> PatchStore:
    with StoreWriter(path, source="kitti-mot") as writer:
        for record in records:
            writer.append(record)
    return open_store(path)


GEOMETRY = (
    "fx", "fy", "cx", "cy", "frame_width", "frame_height", "crop_x0", "crop_y0", "crop_width", "crop_height",
    "camera_offset", "box2d", "box_center", "box_size", "box_yaw",
)  # fmt: skip


def assert_same_geometry(one: PatchRecord, other: PatchRecord) -> None:
    for name in GEOMETRY:
        wanted = getattr(one, name)
        assert getattr(other, name) == (wanted if wanted is None else pytest.approx(wanted, rel=1e-12, abs=1e-12)), name


def test_other_sources_come_back_with_the_same_geometry(tmp_path: Path) -> None:
    records = [made_record(index) for index in range(3)]
    export_legacy(write_store(tmp_path / "store", *records), tmp_path / "out")
    text = json.loads((tmp_path / "out" / "km.json").read_text())
    assert text["dataset_name"] == "km"
    assert text["instances"][1]["patch"] == "patch/km_0300001012_patch.png"
    for record, again in zip(records, import_files(tmp_path / "out", tmp_path / "again").records(), strict=True):
        assert (again.patch_id, again.instance_id) == (record.patch_id, record.instance_id)
        assert_same_geometry(record, again)
        was, now = record.decode(), again.decode()
        np.testing.assert_array_equal(now.image, was.image)
        np.testing.assert_array_equal(now.mask == MaskValue.CAR, was.mask == MaskValue.CAR)
        assert not (now.mask == MaskValue.UNKNOWN).any()


def test_made_records_obey_the_releases_formulas(tmp_path: Path) -> None:
    """Box centre of the store in the canonical frame of the json's own formula, with P2's translation: the origin."""
    record = made_record(4)
    export_legacy(write_store(tmp_path / "store", record), tmp_path / "out")
    value = json.loads((tmp_path / "out" / "km.json").read_text())["instances"][0]
    assert record.box_center is not None
    center = np.array([*record.box_center, 1.0]) * [1, -1, -1, 1]  # OpenGL
    transform = released_formulas.canonical_from_opengl(value, released_formulas.offset(value))
    np.testing.assert_allclose(transform @ center, [0, 0, 0, 1], atol=1e-12)
    front = np.array([np.cos(-1.57), 0, -np.sin(-1.57), 0]) * 2.1 * [1, -1, -1, 1]
    np.testing.assert_allclose(transform @ (center + front), [1, 0, 0, 1], atol=1e-12)
    with Image.open(tmp_path / "out" / value["patch"]) as patch, Image.open(tmp_path / "out" / value["mask"]) as mask:
        assert (patch.format, patch.mode, mask.format, mask.mode) == ("PNG", "RGB", "PNG", "L")
        assert set(np.unique(np.asarray(mask))) == {0, 255}


def test_names_by_source_and_identity(tmp_path: Path) -> None:
    records = [
        made_record(0, patch_id="ko-000748-003", instance_id="ko-000748-003"),
        made_record(1, patch_id="phone-1", instance_id="my-car"),
        made_record(2, patch_id="phone-2", instance_id="other"),
        made_record(3, patch_id="phone-3", instance_id="my-car"),
        made_record(4, patch_id="km-0123-000000-004"),  # no room for sequence 123
    ]
    summary = export_legacy(write_store(tmp_path / "store", *records), tmp_path / "out")
    assert summary.files == {"dv.json": 4, "ko.json": 1}
    names = [path.name for path in sorted((tmp_path / "out" / "mask").iterdir())]
    assert names == [
        "dv_0000000000001_mask.png",
        "dv_0000001000002_mask.png",
        "dv_0000002000001_mask.png",
        "dv_0000003000003_mask.png",
        "ko_000074800003_mask.png",
    ]
    again = import_files(tmp_path / "out", tmp_path / "again", subset="dv")
    assert again.table(["instance_id"])["instance_id"].to_pylist() == [
        "dv-000001",
        "dv-000002",
        "dv-000001",
        "dv-000003",
    ]
    assert DATASET_NAMES["dv"] == json.loads((tmp_path / "out" / "dv.json").read_text())["dataset_name"]


def test_a_crop_that_is_not_the_box_becomes_the_box(tmp_path: Path) -> None:
    record = made_record(0, box2d=(610.0, 175.0, 640.0, 190.0), frame_width=None, frame_height=None, frame_id="a")
    export_legacy(write_store(tmp_path / "store", record), tmp_path / "out")
    value = json.loads((tmp_path / "out" / "km.json").read_text())["instances"][0]
    assert [value[key] for key in ("xmin", "ymin", "xmax", "ymax")] == [600.0, 170.0, 649.0, 199.0]
    assert not {"w", "h"} & value.keys()
    again = next(import_files(tmp_path / "out", tmp_path / "again").records())
    assert_same_geometry(replace(record, box2d=(600.0, 170.0, 649.0, 199.0)), again)


def test_what_the_format_cannot_say_is_left_out_and_counted(tmp_path: Path) -> None:
    tilted = (0.9961947, 0.0871557, 0.0, 0.0)  # 10 degrees about x
    upright = (np.cos(0.4), 0.0, np.sin(0.4), 0.0)
    records = [
        made_record(0),
        made_record(1, mask=None),
        made_record(2, box_center=None, box_size=None, box_yaw=None),
        made_record(3, box_rotation=tilted),
        made_record(4, box_rotation=tuple(map(float, upright)), box_yaw=None),
        made_record(5, crop_x0=-3),
        made_record(6, crop_x0=1200),
    ]
    summary = export_legacy(write_store(tmp_path / "store", *records), tmp_path / "out")
    assert summary.files == {"km.json": 2}
    assert summary.left_out == {
        "crop sticks out of the photograph": 2,
        "no mask": 1,
        "no 3-D box": 1,
        "box not upright: the format knows only its yaw": 1,
    }
    values = json.loads((tmp_path / "out" / "km.json").read_text())["instances"]
    assert [value["yaw"] for value in values] == pytest.approx([-1.57, 0.8])


def test_synthetic_cars_round_trip(tmp_path: Path) -> None:
    synthesize(SynthConfig(out=tmp_path / "store", cars=2, views=3, size=64, cameras="kitti", workers=1))
    store = open_store(tmp_path / "store")
    assert export_legacy(store, tmp_path / "out").files == {"dv.json": 6}
    again = import_files(tmp_path / "out", tmp_path / "again")
    assert again.verify() == []
    instances: dict[str, str] = {}
    for record, other in zip(store.records(), again.records(), strict=True):
        assert_same_geometry(record, other)
        assert instances.setdefault(record.instance_id, other.instance_id) == other.instance_id
        assert (other.image, other.mask) == (record.image, record.mask)
        assert other.box_iou == pytest.approx(record.box_iou, abs=2e-6)  # synth measures it in float32
    assert len(set(instances.values())) == 2


def test_real_frames_round_trip(test_data: Path, tmp_path: Path) -> None:
    config = BuildConfig(
        source="kitti-mot", root=test_data / "kitti-mot", out=tmp_path / "store", frames="0-1", workers=1
    )
    build(config)
    store = open_store(tmp_path / "store")
    assert store.patch_ids()
    export_legacy(store, tmp_path / "out")
    for other in import_files(tmp_path / "out", tmp_path / "again").records():
        record = store.record(other.patch_id)
        assert_same_geometry(record, other)
        assert (other.instance_id, other.box_iou) == (record.instance_id, record.box_iou)


def spoil(**changes: Any) -> Callable[[str], str]:
    """Extra of an imported patch with other keys of ours or of the record."""

    def change(extra: str) -> str:
        value = json.loads(extra)
        value["record"] |= {key: new for key, new in changes.items() if key in value["record"]}
        value |= {key: new for key, new in changes.items() if key not in value["record"]}
        value["record"] = value.pop("record")  # stays last
        return json.dumps(value)

    return change


HOSTILE = [
    (spoil(patch="../../climbed.png"), "leaves its folder"),
    (spoil(patch="/tmp/climbed.png"), "leaves its folder"),
    (spoil(patch="km.json"), "expected a name of a picture"),
    (spoil(patch=UNFINISHED), "expected a name of a picture"),
    (spoil(patch="x" * 900 + ".png"), "cannot be written"),
    (spoil(json="../km.json"), "leaves its folder"),
    (spoil(json="a/km.json"), "expected a file name that ends in .json"),
    (spoil(json="km.png"), "expected a file name that ends in .json"),
    (spoil(yaw="x"), "its record in `extra` is broken: yaw must be a finite number"),
    (spoil(index="0"), "extra is not what an import of the authors' files writes"),
    (spoil(mask_png="!"), "extra is not what an import of the authors' files writes"),
    (lambda extra: extra[:-9], "extra is not what an import of the authors' files writes"),
    (lambda extra: extra + " ", "extra is not what an import of the authors' files writes"),
]


@pytest.mark.parametrize(("change", "message"), HOSTILE, ids=range(len(HOSTILE)))
def test_a_hostile_store_writes_nothing_outside(
    imported: Path, tmp_path: Path, change: Callable[[str], str], message: str
) -> None:
    record = next(open_store(imported).records())
    store = write_store(tmp_path / "store", replace(record, extra=change(record.extra)))
    with pytest.raises(InputError) as caught:
        export_legacy(store, tmp_path / "deep" / "out")
    assert message in str(caught.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep", "store"]
    assert {path.name for path in (tmp_path / "deep" / "out").iterdir()} <= {UNFINISHED, "patch", "mask"}


def test_two_patches_cannot_want_one_file(imported: Path, tmp_path: Path) -> None:
    record = next(open_store(imported).records())
    other = made_record(0, patch_id="km-0001-000097-004", instance_id="x")
    with pytest.raises(InputError, match="two patches want this file"):
        export_legacy(write_store(tmp_path / "a", replace(record, patch_id="a"), other), tmp_path / "out-a")
    other = replace(other, patch_id="km-0009-000097-004")
    with pytest.raises(InputError, match=r"km\.json: the store holds patches of the authors' file and others"):
        export_legacy(write_store(tmp_path / "b", record, other), tmp_path / "out-b")


def test_an_export_never_overwrites(imported: Path, tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(InputError, match="holds other files; choose a new or an empty folder"):
        export_legacy(open_store(imported), tmp_path / "notes")
    with pytest.raises(InputError, match="expected a folder to export to, found a file"):
        export_legacy(open_store(imported), tmp_path / "notes" / "a.txt")
    export_legacy(open_store(imported), tmp_path / "out")
    with pytest.raises(InputError, match="holds other files"):
        export_legacy(open_store(imported), tmp_path / "out")


def test_an_interrupted_export_is_finished_by_the_same_command(authors: Path, imported: Path, tmp_path: Path) -> None:
    def interrupt(description: str, done: int, total: int, note: str = "") -> None:
        if done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export_legacy(open_store(imported), tmp_path / "out", report=interrupt)
    assert not list((tmp_path / "out").glob("*.json"))
    killed = tmp_path / "out" / ".km-abcdefgh.partial.json"  # a kill leaves this: nobody tidies up
    assert is_partial(killed)
    killed.write_text("{")
    export_legacy(open_store(imported), tmp_path / "out")
    assert tree(tmp_path / "out") == tree(authors)


def test_nothing_to_export_is_told(tmp_path: Path) -> None:
    store = write_store(tmp_path / "store", made_record(0, mask=None))
    with pytest.raises(InputError, match=r"no patch can be exported \(1 x no mask\)"):
        export_legacy(store, tmp_path / "out")
    store.write_verdicts([Verdict(store.patch_ids()[0], False, "x")])
    with pytest.raises(InputError, match=r"no patch can be exported \(none is kept\)"):
        export_legacy(open_store(store.path), tmp_path / "out")


def test_refilter_judges_and_splits_again(imported: Path, authors: Path, tmp_path: Path) -> None:
    store = import_files(authors, tmp_path / "store", subset="km")
    outcome = refilter(store, FilterRecipe(height_px=36.0, mask_ratio=0.0, box_iou=0.0))
    kept = [r.patch_id for r in store.light_records() if r.box2d[3] - r.box2d[1] >= 36.0]
    assert 0 < len(kept) < 4
    assert open_store(store.path).patch_ids() == kept
    assert outcome.value["reasons"] == {"kept": len(kept), "height_px": 4 - len(kept)}
    assert sum(outcome.value["splits"]["released-patch"].values()) == len(kept)
    assert open_store(store.path).verify() == []


def test_the_command_line_from_their_files_and_back(
    authors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, out = str(tmp_path / "store"), str(tmp_path / "out")
    assert (
        run(["build", "legacy-json", "--root", str(authors), "--subset", "km", "--out", store, "--workers", "1"]) == 0
    )
    assert "4 candidates" in capsys.readouterr().out
    assert (
        run(["dataset", "refilter", store, "--height-px", "36", "--mask-ratio", "0", "--box-iou", "0", "--json"]) == 0
    )
    kept = json.loads(capsys.readouterr().out)["reasons"]["kept"]
    assert 0 < kept < 4
    assert run(["dataset", "export", store, "--format", "legacy-json", "--out", out, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"out": out, "files": {"km.json": kept}, "left_out": {}}
    assert run(["dataset", "export", store, "--patches", "all", "--out", str(tmp_path / "all")]) == 0
    assert (tmp_path / "all" / "km.json").read_bytes() == (authors / "km.json").read_bytes()
    assert run(["dataset", "export", store, "--out", out]) == 2
    assert "holds other files" in capsys.readouterr().err
    for arguments, option in (
        (["export", store], "--out"),
        (["info", store, "--out", out], "--out"),
        (["export", store, "--out", out, "--depth-m", "40"], "--depth-m"),
    ):
        with pytest.raises(SystemExit, match="2"):
            run(["dataset", *arguments])
        assert option in capsys.readouterr().err
