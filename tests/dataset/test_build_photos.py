"""Photographs without labels, from folder to store: KITTI frames as plain photos, turned photos, DVM-Cars' rules."""

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from carstudio.dataset import plans
from carstudio.dataset.build import BuildConfig, build
from carstudio.dataset.duplicates import read_duplicates
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.inputs import digest_of_inputs
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.plans import input_places
from carstudio.dataset.sources.dvm_cars import expected_yaw
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.images import decode_image, encode_png
from carstudio.perception.coco import read_results
from carstudio.perception.results import Detection2D, Photo
from carstudio.perception.rle import encode_rle
from carstudio.synthetic.cars import draw_car
from carstudio.synthetic.photographs import draw_photographs
from dataset.made_up_kitti import P2, car_line, made_up_kitti
from perception.tiny_hub import photograph, save_dfine, save_sam, save_sam2

KEEP_ALL = FilterRecipe(height_px=0.0, width_px=0.0, box_iou=0.0, mask_ratio=-1.0, score_mask=0.0)


def results(path: Path, boxes: dict[str, list[list[float]]], score: float = 0.9) -> Path:
    """A results file: for each photograph [x0, y0, x1, y1] of its cars."""
    content = [
        {"image_id": name, "category_id": 3, "bbox": [x0, y0, x1 - x0, y1 - y0], "score": score}
        for name, found in boxes.items()
        for x0, y0, x1, y1 in found
    ]
    path.write_text(json.dumps(content))
    read_results.cache_clear()
    return path


def build_photos(root: Path | str, out: Path, **more: object) -> PatchStore:
    values: dict[str, object] = {"source": "photos", "root": root, "out": out, "workers": 1, "filters": KEEP_ALL}
    summary = build(BuildConfig(**(values | more)))  # type: ignore[arg-type]  # by name
    store = open_store(out)
    assert store.verify() == []
    assert summary.candidates == len(store)
    return store


def test_photos_with_calibration_and_known_boxes_equal_the_labelled_build(tmp_path: Path) -> None:
    """The same frames, once with labels and once as plain photographs with all that in files of others."""
    root = made_up_kitti(tmp_path / "kitti")
    labelled = build(
        BuildConfig(source="kitti-mot", root=root, out=tmp_path / "labelled", workers=1, frames="0-1", filters=KEEP_ALL)
    )
    assert labelled.candidates == 3
    boxes, texts, calibration = {}, tmp_path / "boxes", tmp_path / "calib"
    texts.mkdir()
    calibration.mkdir()
    for frame, places in {"000000": [(0.0, 6.0), (0.8, 9.0)], "000001": [(0.1, 5.0)]}.items():
        lines = [car_line(x, z) for x, z in places]
        (texts / f"{frame}.txt").write_text("\n".join(lines))
        (calibration / f"{frame}.txt").write_text(P2)
        boxes[f"{frame}.png"] = [[float(word) for word in line.split()[4:8]] for line in lines]
    photos = build_photos(
        root / "training" / "image_02" / "0000",
        tmp_path / "photos",
        frames="0-1",
        detector=f"precomputed:{results(tmp_path / 'r.json', boxes)}",
        box3d=f"precomputed:{texts}",
        camera=f"calib:{calibration}",
    )
    ours = {record.box2d: record for record in open_store(tmp_path / "labelled").records()}
    theirs = {record.box2d: record for record in photos.records()}
    assert len(theirs) == 3
    for box, record in theirs.items():
        twin = ours[min(ours, key=lambda other: abs(other[0] - box[0]) + abs(other[3] - box[3]))]
        assert box == pytest.approx(twin.box2d)
        for name in ("fx", "fy", "cx", "cy", "camera_offset", "box_center", "box_size", "box_yaw", "sha256", "box_iou"):
            assert getattr(record, name) == pytest.approx(getattr(twin, name)), name
        assert (record.camera_source, record.score_2d, record.licence) == ("calib:P2", 0.9, "unknown")


def shaded(height: int, width: int) -> np.ndarray:
    """A smooth picture without symmetry."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // width, y * 255 // height, (x + y) % 256], axis=-1).astype(np.uint8)


def test_a_turned_photograph_gives_the_same_patch(tmp_path: Path) -> None:
    """Once upright, once stored on its side with EXIF that says so: the turn is applied once, everywhere."""
    upright = shaded(200, 150)
    folder = tmp_path / "p"
    folder.mkdir()
    (folder / "plain.png").write_bytes(encode_png(upright))
    exif = Image.Exif()
    exif[0x0112] = 6  # stored with its top to the right: turned clockwise to be upright
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(np.rot90(upright, 1))).save(buffer, "PNG", exif=exif)
    (folder / "turned.png").write_bytes(buffer.getvalue())
    boxes = {name: [[20.0, 60.0, 119.0, 139.0]] for name in ("plain.png", "turned.png")}
    detector = f"precomputed:{results(tmp_path / 'r.json', boxes)}"
    store = build_photos(folder, tmp_path / "s", detector=detector, licence="CC0-1.0")
    plain, turned = store.records()
    assert (plain.frame_width, plain.frame_height) == (turned.frame_width, turned.frame_height) == (150, 200)
    np.testing.assert_array_equal(decode_image(plain.image, name="p"), upright[60:140, 20:120])
    assert plain.sha256 == turned.sha256
    assert (
        (plain.fx, plain.cx, plain.cy)
        == (turned.fx, turned.cx, turned.cy)
        == (pytest.approx(116.19, abs=0.01), 75, 100)
    )
    assert (plain.camera_source, plain.licence) == ("assumed:kitti-fov", "CC0-1.0")
    assert {verdict.reason for verdict in store.verdicts()} == {"box3d"}  # a valid record with that verdict


def test_masks_of_a_results_file_and_overlapping_cars(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    folder.mkdir()
    (folder / "a.png").write_bytes(encode_png(shaded(100, 160)))
    left, right = np.zeros((100, 160), bool), np.zeros((100, 160), bool)
    left[20:80, 10:90] = True
    right[30:70, 70:150] = True
    content = [
        {
            "image_id": "a.png",
            "category_id": 3,
            "bbox": [10, 20, 80, 60],
            "score": 0.9,
            "segmentation": encode_rle(left),
        },
        {
            "image_id": "a.png",
            "category_id": 8,
            "bbox": [70, 30, 80, 40],
            "score": 0.8,
            "segmentation": encode_rle(right),
        },
    ]
    file = results(tmp_path / "r.json", {})
    file.write_text(json.dumps(content))
    store = build_photos(folder, tmp_path / "s", detector=f"precomputed:{file}", segmenter=f"precomputed:{file}")
    (record,) = store.records()  # the truck is no candidate, but its pixels are sorted out
    mask = record.decode().mask
    expected = np.full((61, 81), MaskValue.BACKGROUND, np.uint8)
    expected[:60, :80] = MaskValue.CAR
    expected[10:50, 60:80] = MaskValue.UNKNOWN
    np.testing.assert_array_equal(mask, expected)
    assert record.mask_ratio == pytest.approx((60 * 80 - 40 * 20) / (61 * 81))
    assert (record.score_2d, record.score_mask) == (0.9, 0.9)


def test_one_bad_photo_of_many_costs_only_itself(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    folder.mkdir()
    for number in range(7):
        (folder / f"{number}.png").write_bytes(encode_png(shaded(90, 120)))
    (folder / "3.png").write_bytes(b"no picture")
    boxes = {f"{number}.png": [[10.0, 10.0, 80.0, 80.0]] for number in range(7)}
    config = BuildConfig(
        source="photos",
        root=folder,
        out=tmp_path / "s",
        workers=1,
        detector=f"precomputed:{results(tmp_path / 'r.json', boxes)}",
    )
    summary = build(config)
    assert summary.candidates == 6
    assert [problem.split(":")[0] for problem in summary.problems] == ["frame 3 skipped"]
    two = build(replace(config, out=tmp_path / "two", workers=2))
    assert two.candidates == 6
    for shard in sorted((tmp_path / "s" / "data").iterdir()):
        assert shard.read_bytes() == (tmp_path / "two" / "data" / shard.name).read_bytes()


REFUSED = {
    "photos has no labels; name a detector": {"detector": "labels"},
    "--box3d labels: photos has no labels": {"detector": "DETECTOR", "box3d": "labels"},
    "--sequence is for kitti-mot; photos has no sequences": {"detector": "DETECTOR", "sequence": "0001"},
    "--camera is for photos and dvm-cars; kitti-mot has its own": {"source": "kitti-mot", "camera": "500"},
    "--licence is for photos; kitti-mot has its own": {"source": "kitti-mot", "licence": "CC0-1.0"},
    "legacy-json takes patches and masks as they are": {"source": "legacy-json", "detector": "DETECTOR"},
}


@pytest.mark.parametrize(("message", "options"), REFUSED.items())
def test_options_that_do_not_go_together(tmp_path: Path, message: str, options: dict[str, str]) -> None:
    root = made_up_kitti(tmp_path / "kitti")
    detector = f"precomputed:{results(tmp_path / 'r.json', {})}"
    options = {name: detector if value == "DETECTOR" else value for name, value in options.items()}
    source = options.pop("source", "photos")
    folder = root if source != "photos" else root / "training" / "image_02" / "0000"
    with pytest.raises(InputError) as caught:
        build(BuildConfig(source=source, root=folder, out=tmp_path / "s", **options))  # type: ignore[arg-type]
    assert message in str(caught.value)


def dvm_folder(root: Path, adverts: dict[str, tuple[list[float], float]]) -> Path:
    """DVM-Cars' layout with one photograph of 300 x 300 px for each advert, and its viewpoint in the table."""
    rows = []
    for number, (advert, (_, viewpoint)) in enumerate(adverts.items()):
        name = f"Make$$Model X$$2017$$Blue$${advert.replace('-', '$$')}$$image_{number}.jpg"
        path = root / "resized_DVM" / "Make" / "Model X" / "2017" / "Blue" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(shaded(300, 300)).save(path, quality=95)
        rows.append((advert.split("-")[0], f"id{number}", name, viewpoint, "P"))
    with (root / "Image_table.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["Genmodel_ID", " Image_ID", " Image_name", " Predicted_viewpoint", " Quality_check"])
        writer.writerows(rows)
    return root


def kitti_result(box: list[float], yaw: float, score: float, depth: float) -> str:
    x0, y0, x1, y1 = box
    x = ((x0 + x1) / 2 - 150) / 721.5377 * depth
    y = (y1 - 150) / 721.5377 * depth
    return f"Car -1 -1 0 {x0} {y0} {x1} {y1} 1.5 1.8 4.2 {x} {y} {depth} {yaw} {score}"


GOOD = [60.0, 100.0, 240.0, 200.0]
RULES = {  # advert -> box, its score, 3-D score, viewpoint that the table tells, yaw of the 3-D box, the verdict
    "1_1-1": (GOOD, 0.9, 0.9, 90.0, 0.1, "kept"),
    "1_1-2": (GOOD, 0.5, 0.9, 90.0, 0.1, "score_2d"),
    "1_1-3": (GOOD, 0.9, 0.5, 90.0, 0.1, "score_3d"),
    "1_1-4": (GOOD, 0.9, 0.9, 90.0, math.radians(21.0), "viewpoint_deg"),
    "1_1-5": (GOOD, 0.9, 0.9, 270.0, 0.1, "viewpoint_deg"),
    "1_1-6": ([110.0, 100.0, 240.0, 200.0], 0.9, 0.9, 90.0, 0.1, "centred"),
    "1_1-7": ([60.0, 100.0, 190.0, 200.0], 0.9, 0.9, 90.0, 0.1, "centred"),
    "1_1-8": ([60.0, 160.0, 240.0, 280.0], 0.9, 0.9, 90.0, 0.1, "centred"),
    "1_1-9": ([60.0, 120.0, 240.0, 180.0], 0.9, 0.9, 90.0, 0.1, "height_px"),
    "1_2-1": ([130.0, 100.0, 190.0, 200.0], 0.9, 0.9, 90.0, 0.1, "width_px"),
    "1_2-2": (GOOD, 0.9, 0.9, 360.0, math.radians(90.0), "kept"),  # 450 - 360 = 90
    "1_2-3": (GOOD, 0.9, None, 90.0, 0.1, "box3d"),
}


def test_dvm_cars_with_every_released_rule(tmp_path: Path) -> None:
    root = dvm_folder(tmp_path / "dvm", {advert: (rule[0], rule[3]) for advert, rule in RULES.items()})
    boxes3d = tmp_path / "boxes"
    boxes3d.mkdir()
    content = []
    for number, (advert, (box, score, score_3d, _, yaw, _)) in enumerate(RULES.items()):
        frame = f"{advert}-{number}"
        content.append(
            {
                "image_id": frame,
                "category_id": 3,
                "bbox": [box[0], box[1], box[2] - box[0], box[3] - box[1]],
                "score": score,
                "segmentation": encode_rle(np.pad(np.ones((160, 200), bool), ((90, 50), (50, 50)))),
            }
        )
        if score_3d is not None:
            depth = 721.5377 * 1.8 / (box[3] - box[1])
            (boxes3d / f"{frame}.txt").write_text(kitti_result(box, yaw, score_3d, depth))
    file = results(tmp_path / "r.json", {})
    file.write_text(json.dumps(content))
    config = BuildConfig(
        source="dvm-cars",
        root=root,
        out=tmp_path / "s",
        workers=1,
        detector=f"precomputed:{file}",
        segmenter=f"precomputed:{file}",
        box3d=f"precomputed:{boxes3d}",
    )
    summary = build(config)
    assert summary.problems == ()
    store = open_store(tmp_path / "s")
    reasons = {record.instance_id: verdict for record, verdict in zip(store.records(), store.verdicts(), strict=True)}
    box_iou = {advert for advert, verdict in reasons.items() if "box_iou" in verdict.failed}
    for advert, rule in RULES.items():
        failed = [name for name in reasons[f"dv-{advert}"].failed if name not in ("box_iou", "mask_ratio")]
        assert failed[:1] == ([] if rule[5] == "kept" else [rule[5]]), (advert, reasons[f"dv-{advert}"])
    assert len(box_iou) < len(RULES)
    record = next(record for record in store.records() if record.instance_id == "dv-1_2-2")
    assert (record.fx, record.cx, record.camera_source) == (721.5377, 150.0, "paper")
    assert record.sequence_id == "1_2-2"
    assert json.loads(record.extra) == {
        "box3d_type": "Car",
        "colour": "Blue",
        "expected_yaw_deg": 90.0,
        "make": "Make",
        "model": "Model X",
        "predicted_viewpoint_deg": 360.0,
        "type": "Car",
        "year": "2017",
    }


@pytest.mark.parametrize(
    ("viewpoint", "yaw"), [(0, 90), (45, 45), (90, 0), (180, -90), (270, -180), (315, 135), (360, 90)]
)
def test_viewpoints_as_released(viewpoint: float, yaw: float) -> None:
    """450 minus the viewpoint, between -180 and 180."""
    assert expected_yaw(float(viewpoint)) == pytest.approx(yaw)


def test_dvm_cars_without_table_or_with_odd_names(tmp_path: Path) -> None:
    root = dvm_folder(tmp_path / "dvm", {"1_1-1": (GOOD, 90.0)})
    table = root / "Image_table.csv"
    detector = f"precomputed:{results(tmp_path / 'r.json', {})}"
    config = BuildConfig(source="dvm-cars", root=root, out=tmp_path / "s", workers=1, detector=detector)
    good = table.read_text()
    table.write_text(good.replace("90.0", "front"))
    assert "Predicted_viewpoint must be a number of degrees, found 'front'" in build(config).problems[0]
    table.write_text(good.replace("Predicted_viewpoint", "View"))
    with pytest.raises(InputError, match=r"Image_table\.csv: no column Predicted_viewpoint; found"):
        build(replace(config, out=tmp_path / "t"))
    table.unlink()
    (root / "resized_DVM" / "Make" / "Model X" / "2017" / "Blue" / "odd.jpg").write_bytes(b"")
    problems = build(replace(config, out=tmp_path / "u")).problems
    assert "the viewpoint rule does not apply" in problems[0]
    assert problems[1].startswith("odd.jpg: expected MAKE$$MODEL")
    with pytest.raises(InputError, match="no folder resized_DVM; expected resized_DVM/MAKE/MODEL/YEAR/COLOUR"):
        build(replace(config, root=tmp_path, out=tmp_path / "v"))


def test_real_frames_as_plain_photographs(test_data: Path, tmp_path: Path) -> None:
    """The whole way with real networks; a rough camera leaves hardly a box at its place."""
    pytest.importorskip("onnxruntime")
    folder = test_data / "kitti-obj" / "training"
    options: dict[str, object] = {
        "detector": f"onnx:{test_data}/detector/yolox_nano.onnx",
        "segmenter": f"onnx:{test_data}/segmenter/espnetv2_voc.onnx",
        "box3d": f"precomputed:{folder}/label_2",
        "filters": FilterRecipe(),
        "frames": "6-10",
    }
    exact = build_photos(folder / "image_2", tmp_path / "exact", camera=f"calib:{folder}/calib", **options)
    assert exact.info()["kept"] >= 7
    assert np.median([record.box_iou for record in exact.records() if record.box_iou is not None]) > 0.8
    rough = build_photos(folder / "image_2", tmp_path / "rough", camera="1500", **options)
    assert rough.info()["kept"] < exact.info()["kept"]


@pytest.mark.parametrize("kind", ["sam", "sam2"])
def test_pretrained_networks_from_folders(tmp_path: Path, kind: str) -> None:
    """Small random networks in place of the hub's: D-FINE finds boxes, SAM or SAM 2 cuts; workers change no byte."""
    (tmp_path / "detector").mkdir()
    (tmp_path / "sam").mkdir()
    save_dfine(tmp_path / "detector", names=("car", "truck", "bus", "van"))
    {"sam": save_sam, "sam2": save_sam2}[kind](tmp_path / "sam")
    folder = tmp_path / "p"
    folder.mkdir()
    for number in range(9):
        (folder / f"{number}.png").write_bytes(encode_png(photograph(90 + number, 120, seed=number)))
    options = {"detector": f"transformers:{tmp_path}/detector", "segmenter": f"{kind}:{tmp_path}/sam"}
    one = build_photos(folder, tmp_path / "one", types=("Car", "Truck", "Bus", "Van"), **options)
    two = build_photos(folder, tmp_path / "two", types=("Car", "Truck", "Bus", "Van"), workers=2, **options)
    assert len(one) > 9
    assert one.data_sha256 == two.data_sha256
    records = list(one.records())
    assert all(record.score_2d is not None and record.score_mask is not None for record in records)
    shares = [record.mask_ratio for record in records if record.mask_ratio is not None]
    assert 0.01 < float(np.mean(shares)) < 0.99


def test_dvm_cars_made_of_synthetic_cars(tmp_path: Path) -> None:
    """Photographs of parametric cars in DVM's layout, with true boxes, masks and cameras: each stays at its true place;
    none stays where the table tells another side of it."""
    root, boxes3d, calibration = tmp_path / "dvm", tmp_path / "boxes", tmp_path / "calib"
    folder = root / "resized_DVM" / "Make" / "Model" / "2017" / "Blue"
    for path in (folder, boxes3d, calibration):
        path.mkdir(parents=True)
    content, rows, truth = [], [], {}
    for number in range(4):
        car = draw_car(np.random.default_rng([5, number]))
        (photo,) = draw_photographs(car, seed=(5, number), num_views=1, size_px=300, cameras="kitti")
        name = f"Make$$Model$$2017$$Blue$$1_1$${number}$$image_0.jpg"
        Image.fromarray(photo.image).save(folder / name, quality=95)
        fx, fy, cx, cy = photo.viewpoint.camera.intrinsics.tolist()
        frame = f"1_1-{number}-0"
        (calibration / f"{frame}.txt").write_text(f"P2: {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0")
        box = photo.viewpoint.box(car.mesh)
        center, (length, height, width), yaw = box.center.tolist(), box.size.tolist(), float(box.yaw_rad)
        v, u = np.nonzero(photo.mask)
        x0, y0, x1, y1 = int(u.min()), int(v.min()), int(u.max()) + 1, int(v.max()) + 1
        place = f"{center[0]} {center[1] + height / 2} {center[2]} {yaw}"
        (boxes3d / f"{frame}.txt").write_text(f"Car -1 -1 0 {x0} {y0} {x1} {y1} {height} {width} {length} {place} 0.9")
        result = {"image_id": frame, "category_id": 3, "bbox": [x0, y0, x1 - x0, y1 - y0], "score": 0.9}
        content.append(result | {"segmentation": encode_rle(photo.mask)})
        rows.append((name, 450.0 - math.degrees(yaw)))
        truth[frame] = box
    file = results(tmp_path / "r.json", {})
    file.write_text(json.dumps(content))
    for out, offset, reasons in (("s", 0.0, {"kept"}), ("t", 90.0, {"viewpoint_deg"})):
        with (root / "Image_table.csv").open("w", newline="") as table:
            csv.writer(table).writerows([(" Image_name", " Predicted_viewpoint"), *((n, d + offset) for n, d in rows)])
        store = build_photos(
            root,
            tmp_path / out,
            source="dvm-cars",
            filters=FilterRecipe(),
            detector=f"precomputed:{file}",
            segmenter=f"precomputed:{file}",
            box3d=f"precomputed:{boxes3d}",
            camera=f"calib:{calibration}",
        )
        found = {verdict.reason for verdict in store.verdicts()} - {"centred", "height_px", "mask_ratio"}
        assert found == reasons
    assert store.info()["kept"] == 0
    for record in open_store(tmp_path / "s").records():
        box = truth[record.frame_id]
        assert record.box_center == pytest.approx(box.center.tolist(), abs=1e-5)
        assert record.box_iou is not None
        assert record.box_iou > 0.8  # a car's silhouette does not fill the envelope of its box


@dataclass(frozen=True)
class Touchy:
    """A detector that fails on dark photographs, alone or in company."""

    def detect(self, photos: Sequence[Photo]) -> list[list[Detection2D]]:
        if any(photo.image.max() == 0 for photo in photos):
            raise InputError("too dark")
        return [[Detection2D((10.0, 10.0, 60.0, 60.0), "Car", 0.9)] for _ in photos]


def test_a_photo_that_the_detector_cannot_bear_costs_only_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plans, "make_detector", lambda spec: Touchy())
    for number in range(6):
        pixels = np.zeros((90, 120, 3), np.uint8) if number == 2 else shaded(90, 120)
        path = tmp_path / "p" / f"{number}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encode_png(pixels))
    config = BuildConfig(source="photos", root=tmp_path / "p", out=tmp_path / "s", workers=1, detector="onnx:x")
    summary = build(config)
    assert summary.problems == ("frame 2 skipped: too dark",)
    assert summary.candidates == 5


def test_copies_of_a_photo_are_found_and_stay_on_one_side(tmp_path: Path) -> None:
    """A build of photographs looks for repeated pictures by itself; one of KITTI, whose cars have names, does not."""
    folder = tmp_path / "p"
    folder.mkdir()
    image = photograph(200, 300, seed=3)
    (folder / "a.png").write_bytes(encode_png(image))
    Image.fromarray(image).save(folder / "b.jpg", quality=60)
    (folder / "c.png").write_bytes(encode_png(photograph(200, 300, seed=4)))
    boxes = {name: [[20.0, 20.0, 279.0, 179.0]] for name in ("a.png", "b.jpg", "c.png")}
    store = build_photos(folder, tmp_path / "s", detector=f"precomputed:{results(tmp_path / 'r.json', boxes)}")
    found = read_duplicates(store)
    assert found is not None
    assert found.group == (0, 0, None)
    assert found.kind == ("near", "near", None)
    root = made_up_kitti(tmp_path / "kitti")
    build(BuildConfig(source="kitti-mot", root=root, out=tmp_path / "k", workers=1))
    assert read_duplicates(open_store(tmp_path / "k")) is None


def test_a_photo_that_a_list_names_is_an_input_too(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(shaded(90, 120)))
    (tmp_path / "list.txt").write_text("a.png\n")
    config = BuildConfig(source="photos", root=tmp_path / "list.txt", out=tmp_path / "s")
    before = digest_of_inputs(input_places(config))
    assert digest_of_inputs(input_places(config)) == before
    (tmp_path / "a.png").write_bytes(encode_png(shaded(91, 120)))
    assert digest_of_inputs(input_places(config)) != before
