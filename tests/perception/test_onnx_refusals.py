"""Networks that are none for us: each is one message before the build begins, with what was expected and found."""

from pathlib import Path

import numpy as np
import pytest

from carstudio.errors import InputError
from carstudio.perception.onnx_segmenter import OnnxSegmenter, open_session
from carstudio.perception.results import SegmentRequest, Window
from carstudio.perception.specs import make_segmenter
from perception.tiny_onnx import INT64, SEVEN_TIMES, network, node

pytest.importorskip("onnxruntime")
SIGMOID = [SEVEN_TIMES, node("Sigmoid", ["classes"], ["out"])]
TWO = (("images", (1, 3, "h", "w")), ("more", (1, 3, "h", "w")))
REFUSED = {
    "an input of one channel": (
        network([node("Concat", ["images"] * 21, ["out"], axis=1)], inputs=(("images", (1, 1, "h", "w")),)),
        r"takes float32 \[1, 3, height, width\].*found one that fails on \[1, 3, 64, 128\]",
    ),
    "an input of whole numbers": (
        network([node("Concat", ["images"] * 7, ["out"], axis=1)], kind=INT64),
        r"takes float32 \[1, 3, height, width\].*found one that fails",
    ),
    "two inputs": (
        network([node("Concat", ["images", *["more"] * 6], ["out"], axis=1)], inputs=TWO),
        r"expected one input, float32 \[1, 3, height, width\], found \['images', 'more'\]",
    ),
    "an output of three classes": (
        network([node("Sigmoid", ["images"], ["out"])], output=(1, 3, "h", "w")),
        r"expected an output \[1, classes, height, width\] with VOC's classes, found \[1, 3, 'h', 'w'\]",
    ),
    "an output of half the size": (
        network([*SIGMOID[:1], node("Sigmoid", ["classes"], ["s"]),
                 node("MaxPool", ["s"], ["out"], kernel_shape=[2, 2], strides=[2, 2])]),
        r"expected an output \[1, classes, 64, 128\] for this photograph, found \[1, 21, 32, 64\]",
    ),
    "numbers instead of probabilities": (
        network([SEVEN_TIMES, node("Sigmoid", ["classes"], ["s"]), node("Add", ["s", "s"], ["t"]),
                 node("Add", ["t", "s"], ["out"])]),
        r"expected probabilities from 0 to 1, found 1\.5 to 1\.5; end the network with a softmax",
    ),
    "no number at all": (
        network([SEVEN_TIMES, node("Log", ["classes"], ["l"]), node("Sub", ["l", "l"], ["out"])]),
        r"expected probabilities from 0 to 1, found nan to nan",
    ),
    "an operator that does not exist": (
        network([node("RunShell", ["images"], ["out"])]),
        "expected an ONNX network, found something else",
    ),
    "no output": (b"\x08\x08", "expected an ONNX network, found something else"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_network_that_is_none_for_us_is_refused_with_its_file(tmp_path: Path, name: str) -> None:
    data, message = REFUSED[name]
    path = tmp_path / "net.onnx"
    path.write_bytes(data)
    open_session.cache_clear()
    with pytest.raises(InputError, match=message) as caught:
        make_segmenter(f"onnx:{path}")
    assert str(caught.value).startswith(str(path))


def test_the_same_network_with_probabilities_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(network(SIGMOID))
    open_session.cache_clear()
    segmenter = make_segmenter(f"onnx:{path}")
    assert isinstance(segmenter, OnnxSegmenter)
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, 40:] = 200  # class 7 is the green channel: sigmoid(0) = 0.5 on the left, 1 on the right
    request = SegmentRequest(image=image, window=Window(10, 10, 60, 40), box2d=(10.0, 10.0, 70.0, 50.0))
    result = segmenter.segment(request)
    assert result.car[:, 32:].all()
    assert not result.car[:, :28].any()
