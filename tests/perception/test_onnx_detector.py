"""The YOLOX detector: decoding against a slow loop, suppression against brute force, and real cars in real frames."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from carstudio.dataset.sources.kitti_format import parse_labels
from carstudio.errors import InputError
from carstudio.images import read_image
from carstudio.perception.onnx_detector import PADDING_GREY, STRIDES, OnnxDetector, decode, letterbox
from carstudio.perception.results import Detection2D, Photo
from carstudio.perception.specs import make_detector
from carstudio.perception.suppression import without_doubles
from perception.tiny_onnx import network, node


def photo_of(image: np.ndarray, name: str = "a") -> Photo:
    return Photo(image=image, frame_id=name, path=f"{name}.png", intrinsics=(700.0, 700.0, 600.0, 180.0))


def iou(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    area = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return width * height / (area - width * height)


def test_decoding_equals_a_loop_over_cells() -> None:
    rng = np.random.default_rng(0)
    rows, columns = 64, 96
    cells = sum((rows // stride) * (columns // stride) for stride in STRIDES)
    output = rng.normal(0, 1, (cells, 85)).astype(np.float32)
    boxes, scores = decode(output, rows, columns)
    index = 0
    for stride in STRIDES:
        for row in range(rows // stride):
            for column in range(columns // stride):
                cx, cy = (output[index, 0] + column) * stride, (output[index, 1] + row) * stride
                w, h = np.exp(output[index, 2]) * stride, np.exp(output[index, 3]) * stride
                np.testing.assert_allclose(boxes[index], [cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2], rtol=1e-5)
                np.testing.assert_allclose(scores[index], output[index, 4] * output[index, 5:])
                index += 1
    assert index == cells


def test_suppression_equals_brute_force() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        corner, size = rng.uniform(0, 50, (25, 2)), rng.uniform(5, 40, (25, 2))
        boxes, scores = np.concatenate([corner, corner + size], axis=1), rng.uniform(0, 1, 25)
        expected: list[int] = []
        for i in sorted(range(25), key=lambda i: -scores[i]):
            if all(iou(tuple(boxes[i]), tuple(boxes[j])) <= 0.4 for j in expected):
                expected.append(i)
        assert without_doubles(boxes, np.argsort(-scores).tolist(), 0.4) == expected


def test_letterbox_puts_the_photograph_top_left_in_bgr() -> None:
    image = np.zeros((40, 50, 3), np.uint8)
    image[..., 0], image[..., 2] = 200, 10
    inputs = letterbox(image, 1.0)
    assert inputs.shape == (1, 3, 64, 64)
    assert inputs[0, :, 39, 49].tolist() == [10, 0, 200]
    assert inputs[0, :, 40, 0].tolist() == inputs[0, :, 0, 50].tolist() == [PADDING_GREY] * 3


def test_other_networks_are_refused_with_the_way_out(tmp_path: Path) -> None:
    file = tmp_path / "net.onnx"
    file.write_bytes(network([node("Concat", ["images"] * 7, ["out"], axis=1)]))
    with pytest.raises(
        InputError, match=r"net\.onnx: expected the output of a YOLOX .*found \[1, 21, 64, 128\]; other"
    ):
        make_detector(f"onnx:{file}")
    with pytest.raises(InputError, match=r"no file .*absent\.onnx; expected a detection network"):
        make_detector(f"onnx:{tmp_path}/absent.onnx")
    with pytest.raises(InputError, match="detector 'sift': expected one of labels, "):
        make_detector("sift")


@pytest.fixture
def detector(test_data: Path) -> OnnxDetector:
    pytest.importorskip("onnxruntime")
    return OnnxDetector(test_data / "detector" / "yolox_nano.onnx")


def test_real_cars_in_real_frames(detector: OnnxDetector, test_data: Path) -> None:
    """All cars of KITTI-DET frames 0 to 10 that are 64 px tall or more, at the boxes that people drew."""
    folder = test_data / "kitti-obj" / "training"
    cars = 0
    for file in sorted((folder / "image_2").glob("*.png")):
        found = detector.detect([photo_of(read_image(file), file.stem)])[0]
        for label in parse_labels((folder / "label_2" / f"{file.stem}.txt").read_text(), name=file.stem):
            if label.type in ("Car", "Van") and label.box2d[3] - label.box2d[1] >= 64:
                cars += 1
                assert max(iou(box.box2d, label.box2d) for box in found) > 0.5, (file.stem, label.line)
    assert cars == 8
    assert all(isinstance(box, Detection2D) for box in found)
    assert [box.score for box in found] == sorted((box.score for box in found), reverse=True)


def test_company_padding_and_pickling_change_nothing(detector: OnnxDetector, test_data: Path) -> None:
    image = read_image(test_data / "kitti-obj" / "training" / "image_2" / "000008.png")
    alone = detector.detect([photo_of(image)])[0]
    again = pickle.loads(pickle.dumps(detector)).detect([photo_of(image[:200]), photo_of(image)])[1]
    assert alone == again
    shifted = detector.detect([photo_of(np.ascontiguousarray(image[:, :-8]))])[0]  # another padding on the right
    for box in alone[:4]:
        if box.box2d[2] < image.shape[1] - 20:
            assert max(iou(box.box2d, other.box2d) for other in shifted) > 0.9


def test_boxes_are_mirrored_with_the_photograph(detector: OnnxDetector, test_data: Path) -> None:
    """A half-pixel or edge mistake would show as a shift between the two."""
    image = read_image(test_data / "kitti-obj" / "training" / "image_2" / "000008.png")
    plain = detector.detect([photo_of(image)])[0]
    mirrored = detector.detect([photo_of(np.ascontiguousarray(image[:, ::-1]))])[0]
    width = image.shape[1]
    back = [(width - box.box2d[2], box.box2d[1], width - box.box2d[0], box.box2d[3]) for box in mirrored]
    shifts = []
    for box in plain[:5]:
        best = max(back, key=lambda other: iou(box.box2d, other))
        assert iou(box.box2d, best) > 0.8
        shifts.append((best[0] + best[2] - box.box2d[0] - box.box2d[2]) / 2)
    assert abs(float(np.mean(shifts))) < 3
