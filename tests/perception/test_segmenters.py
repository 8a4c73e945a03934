"""Segmenters on a photograph whose truth is drawn, their specs, and what they say when they cannot work."""

import builtins
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from carstudio.dataset.patch import MaskValue
from carstudio.errors import InputError
from carstudio.images import encode_png, write_png
from carstudio.perception.grabcut import GrabCutSegmenter
from carstudio.perception.ground_truth import GroundTruthSegmenter
from carstudio.perception.onnx_segmenter import OnnxSegmenter, open_session
from carstudio.perception.precomputed import UNKNOWN_GREY, PrecomputedSegmenter
from carstudio.perception.results import SegmentRequest, Window
from carstudio.perception.specs import make_segmenter, parse_spec

WINDOW = Window(40, 30, 80, 50)
HULL = np.array([[40.0, 30.0], [120.0, 30.0], [120.0, 80.0], [40.0, 80.0]])


@pytest.fixture
def truth() -> np.ndarray:
    """A car-like blob in a photograph of 160 x 110 px."""
    mask = np.zeros((110, 160), np.uint8)
    cv2.ellipse(mask, (80, 58), (38, 20), 0, 0, 360, 1, -1)
    return mask.astype(bool)


@pytest.fixture
def asked(truth: np.ndarray) -> SegmentRequest:
    rng = np.random.default_rng(0)
    image = rng.normal((90, 110, 80), 12, (110, 160, 3))
    image[truth] = rng.normal((170, 30, 40), 12, (int(truth.sum()), 3))
    return SegmentRequest(
        image=image.clip(0, 255).astype(np.uint8),
        window=WINDOW,
        box2d=(40.0, 30.0, 119.5, 79.5),
        hull=HULL,
        patch_id="p-1",
        frame_id="f-1",
    )


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("has_box3d", [True, False])
def test_grabcut_finds_a_red_car_on_green(asked: SegmentRequest, truth: np.ndarray, has_box3d: bool) -> None:
    result = GrabCutSegmenter(core=0.5).segment(asked if has_box3d else replace(asked, hull=None))
    assert iou(result.car, truth[WINDOW.slices]) > 0.97
    assert result.score is None
    assert not result.unknown.any()


def test_grabcut_is_reproducible(asked: SegmentRequest) -> None:
    first = GrabCutSegmenter().segment(asked)
    cv2.setRNGSeed(12345)
    np.random.default_rng().random(10)
    again = pickle.loads(pickle.dumps(GrabCutSegmenter())).segment(asked)
    np.testing.assert_array_equal(first.car, again.car)


def test_grabcut_leaves_the_photograph_alone(asked: SegmentRequest) -> None:
    before = asked.image.copy()
    GrabCutSegmenter().segment(replace(asked, occluders=(HULL + np.array([40.0, 0.0]),)))
    np.testing.assert_array_equal(asked.image, before)


def test_grabcut_calls_nearer_objects_unknown(asked: SegmentRequest, truth: np.ndarray) -> None:
    result = GrabCutSegmenter(core=0.5).segment(replace(asked, occluders=(HULL + np.array([40.0, 0.0]),)))
    assert result.unknown[:, 40:].all()
    assert not result.unknown[:, :40].any()
    assert not (result.car & result.unknown).any()
    assert iou(result.car[:, :40], truth[WINDOW.slices][:, :40]) > 0.95


def test_grabcut_takes_the_core_for_car(asked: SegmentRequest) -> None:
    """Where the colours say nothing the core decides."""
    flat = replace(
        asked, image=np.full_like(asked.image, 100), core=(np.array([[50.0, 40], [70, 40], [70, 60], [50, 60]]),)
    )
    assert GrabCutSegmenter().segment(flat).car[10:30, 10:30].all()


def test_grabcut_survives_odd_requests(asked: SegmentRequest) -> None:
    everywhere = np.array([[-50.0, -50.0], [500.0, -50.0], [500.0, 500.0], [-50.0, 500.0]])
    for changes in (
        {"occluders": (everywhere,)},  # wholly hidden
        {"hull": everywhere},  # nothing is background
        {"window": Window(40, 30, 1, 1), "box2d": (40.0, 30.0, 40.5, 30.5), "hull": None},
    ):
        result = GrabCutSegmenter().segment(replace(asked, **changes))  # type: ignore[arg-type]
        assert result.car.shape == result.unknown.shape


def test_precomputed_mask_of_a_patch_is_believed(asked: SegmentRequest, tmp_path: Path) -> None:
    pixels = np.zeros((50, 80), np.uint8)
    pixels[:, 10:30], pixels[:, 30:40], pixels[:, 40:] = 255, UNKNOWN_GREY, 1
    write_png(tmp_path / "p-1.png", pixels)
    result = PrecomputedSegmenter(tmp_path).segment(replace(asked, hull=HULL[:, ::-1] * 0))
    np.testing.assert_array_equal(result.car, (pixels == 255) | (pixels == 1))
    np.testing.assert_array_equal(result.unknown, pixels == UNKNOWN_GREY)


def test_unknown_grey_is_the_stores() -> None:
    assert UNKNOWN_GREY == MaskValue.UNKNOWN


def test_precomputed_mask_of_a_photo_is_restricted_to_the_car(asked: SegmentRequest, tmp_path: Path) -> None:
    write_png(tmp_path / "f-1.png", np.full((110, 160), 255, np.uint8))
    right = np.array([[100.0, 0.0], [160.0, 0.0], [160.0, 110.0], [100.0, 110.0]])
    left_half = np.array([[40.0, 30.0], [80.0, 30.0], [80.0, 80.0], [40.0, 80.0]])
    result = PrecomputedSegmenter(tmp_path).segment(replace(asked, occluders=(right,)))
    assert result.car[:, :60].all()
    assert result.unknown[:, 60:].all()
    result = PrecomputedSegmenter(tmp_path).segment(replace(asked, hull=left_half))
    assert result.car.mean() == 0.5


def test_precomputed_explains_what_is_missing_or_misshapen(asked: SegmentRequest, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no mask p-1.png and no f-1.png"):
        PrecomputedSegmenter(tmp_path).segment(asked)
    write_png(tmp_path / "f-1.png", np.zeros((5, 6), np.uint8))
    with pytest.raises(InputError, match=r"must have the photograph's size 160 x 110, is 6 x 5"):
        PrecomputedSegmenter(tmp_path).segment(asked)
    write_png(tmp_path / "p-1.png", np.zeros((5, 6), np.uint8))
    with pytest.raises(InputError, match=r"must have the crop's size 80 x 50, is 6 x 5"):
        PrecomputedSegmenter(tmp_path).segment(asked)


def test_ground_truth_hands_on_the_sources_mask(asked: SegmentRequest, truth: np.ndarray) -> None:
    pixels = np.where(truth[WINDOW.slices], 255, 0).astype(np.uint8)
    result = GroundTruthSegmenter().segment(replace(asked, truth_mask=encode_png(pixels)))
    np.testing.assert_array_equal(result.car, truth[WINDOW.slices])
    assert result.score == 1.0
    with pytest.raises(InputError, match="patch p-1: the source has no masks"):
        GroundTruthSegmenter().segment(asked)


def test_specs() -> None:
    assert parse_spec("grabcut") == ("grabcut", None)
    assert parse_spec("onnx:C:/models/a.onnx") == ("onnx", "C:/models/a.onnx")
    assert make_segmenter("grabcut") == GrabCutSegmenter()
    assert make_segmenter("ground-truth") == GroundTruthSegmenter()
    for spec in ("", ":x", "onnx:"):
        with pytest.raises(InputError, match="expected KIND or KIND:ARGUMENT"):
            make_segmenter(spec)
    for spec in ("onnx", "grabcut:fast", "samurai"):
        with pytest.raises(InputError, match="expected one of grabcut, sam"):
            make_segmenter(spec)
    with pytest.raises(InputError, match="precomputed: no folder nowhere"):
        make_segmenter("precomputed:nowhere")


def test_onnx_explains_what_it_cannot_open(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    with pytest.raises(InputError, match=r"onnx: no file missing\.onnx"):
        make_segmenter("onnx:missing.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(InputError, match="expected an ONNX network, found something else"):
        make_segmenter(f"onnx:{tmp_path / 'text.onnx'}")


def test_onnx_without_the_package_names_the_install_line(monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def no_onnxruntime(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "onnxruntime":
            raise ImportError(name)
        return real_import(name, *arguments, **options)

    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    monkeypatch.setattr(builtins, "__import__", no_onnxruntime)
    open_session.cache_clear()
    with pytest.raises(InputError, match=r'pip install "carstudio\[onnx\]"'):
        make_segmenter("onnx:any.onnx")


def test_onnx_refuses_a_network_without_the_classes(test_data: Path) -> None:
    pytest.importorskip("onnxruntime")
    with pytest.raises(InputError, match=r"expected an output \[1, classes, height, width\] with VOC's classes"):
        make_segmenter(f"onnx:{test_data / 'detector' / 'yolox_nano.onnx'}")


@pytest.fixture
def network(test_data: Path) -> OnnxSegmenter:
    pytest.importorskip("onnxruntime")
    return OnnxSegmenter(test_data / "segmenter" / "espnetv2_voc.onnx")


@pytest.fixture
def street_car(test_data: Path) -> SegmentRequest:
    """KITTI object 000010, a white BMW seen whole; its outline is left open (2-D box)."""
    image = cv2.imread(str(test_data / "kitti-obj" / "training" / "image_2" / "000010.png"))
    line = (test_data / "kitti-obj" / "training" / "label_2" / "000010.txt").read_text().splitlines()[1]
    x0, y0, x1, y1 = (float(word) for word in line.split()[4:8])
    window = Window(int(x0), int(y0), int(x1) - int(x0) + 1, int(y1) - int(y0) + 1)
    return SegmentRequest(image=np.ascontiguousarray(image[..., ::-1]), window=window, box2d=(x0, y0, x1, y1))


def test_onnx_finds_a_white_car(network: OnnxSegmenter, street_car: SegmentRequest) -> None:
    result = network.segment(street_car)
    assert result.score is not None
    assert 0.9 < result.score <= 1.0
    assert 0.6 < result.car.mean() < 0.9
    height, width = result.car.shape
    assert result.car[height // 3 : 2 * height // 3, width // 4 : 3 * width // 4].mean() > 0.99
    assert not result.car[:5, :5].any()  # grass above the bonnet
    rgb = street_car.image
    inside, outside = (
        rgb[street_car.window.slices][result.car].mean(),
        rgb[street_car.window.slices][~result.car].mean(),
    )
    assert inside > outside + 40  # a white car before dark trees


def test_onnx_is_restricted_to_the_outline(network: OnnxSegmenter, street_car: SegmentRequest) -> None:
    x0, y0, x1, y1 = street_car.box2d
    middle = (x0 + x1) / 2
    left = np.array([[x0, y0], [middle, y0], [middle, y1], [x0, y1]])
    whole = network.segment(street_car)
    half = network.segment(replace(street_car, hull=left))
    margin = round(network.margin * (y1 - y0)) + 1
    assert not half.car[:, int(middle - x0) + margin :].any()
    assert iou(half.car[:, : int(middle - x0)], whole.car[:, : int(middle - x0)]) > 0.99
    hidden = network.segment(replace(street_car, occluders=(left,)))
    assert not (hidden.car & hidden.unknown).any()
    assert hidden.unknown[1:-1, 1 : int(middle - x0) - 1].all()


def test_onnx_gives_nothing_where_there_is_no_car(network: OnnxSegmenter, street_car: SegmentRequest) -> None:
    blank = replace(street_car, image=np.full_like(street_car.image, 120))
    result = network.segment(blank)
    assert not result.car.any()
    assert result.score == 0.0
