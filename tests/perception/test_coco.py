"""COCO's run lengths and result files: against a slow decoder, by hand, and what is said of malformed ones."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from carstudio.errors import InputError
from carstudio.perception.coco import CocoDetector, CocoSegmenter, read_results
from carstudio.perception.results import Photo, SegmentRequest, Window
from carstudio.perception.rle import decode_rle, encode_rle, runs_from_text, text_from_runs
from carstudio.perception.specs import make_detector, make_segmenter

IMAGE = np.zeros((20, 30, 3), np.uint8)


def slow_mask(runs: list[int], height: int, width: int) -> np.ndarray:
    """Column by column, pixel by pixel."""
    mask, at, value = np.zeros((height, width), bool), 0, False
    for run in runs:
        for place in range(at, at + run):
            mask[place % height, place // height] = value
        at, value = at + run, not value
    return mask


def slow_numbers(text: str) -> list[int]:
    """The compressed form read as a string of bits, two's complement."""
    numbers: list[int] = []
    bits = ""
    for character in text:
        six = f"{ord(character) - 48:06b}"
        bits = six[1:] + bits
        if six[0] == "0":
            value = int(bits, 2) - (1 << len(bits) if bits[0] == "1" else 0)
            numbers.append(value + (numbers[-2] if len(numbers) > 2 else 0))
            bits = ""
    return numbers


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**31))
def test_masks_survive_and_agree_with_the_slow_decoder(height: int, width: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < 0.5
    encoded = encode_rle(mask)
    assert encoded["size"] == [height, width]
    np.testing.assert_array_equal(decode_rle(encoded, name="m"), mask)
    np.testing.assert_array_equal(slow_mask(slow_numbers(encoded["counts"]), height, width), mask)


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=20))
def test_run_lengths_survive_compression(runs: list[int]) -> None:
    text = text_from_runs(runs)
    assert runs_from_text(text, name="m") == slow_numbers(text) == runs


def test_a_text_of_the_annotation_tools() -> None:
    """Worked out by hand from the format: 6, 1, 40, 4 - 1, 5 - 40, 4 - 4, 5 - 5, with 32 marking a second group."""
    runs = [6, 1, 40, 4, 5, 4, 5, 4, 21]
    assert text_from_runs(runs) == "61X13mN000`0"
    assert runs_from_text("61X13mN000`0", name="m") == runs


BROKEN_MASKS: dict[str, Any] = {
    "m: expected run lengths": [1, 2],
    "m: run lengths must be whole numbers from 0 on, found [-1, 601]": {"size": [20, 30], "counts": [-1, 601]},
    "m: run lengths must add up to 20 x 30 pixels, found 5": {"size": [20, 30], "counts": [5]},
    "m: ' ' does not belong in compressed run lengths": {"size": [20, 30], "counts": "1 2"},
    "m: the compressed run lengths end in the middle of a number": {"size": [20, 30], "counts": "X"},
    "m: a mask of 99999 x 99999 pixels; at most 120,000,000 are read": {"size": [99999, 99999], "counts": [1]},
}


@pytest.mark.parametrize(("message", "value"), BROKEN_MASKS.items())
def test_broken_masks_are_explained(message: str, value: Any) -> None:
    with pytest.raises(InputError) as caught:
        decode_rle(value, name="m")
    assert str(caught.value).startswith(message)


def result(image: str | int, box: list[float], *, category: int = 3, score: float = 0.9, **more: Any) -> dict[str, Any]:
    return {"image_id": image, "category_id": category, "bbox": box, "score": score, **more}


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    read_results.cache_clear()
    return path


def photo(path: str, frame_id: str) -> Photo:
    return Photo(image=IMAGE, frame_id=frame_id, path=path, intrinsics=(1.0, 1.0, 1.0, 1.0))


def test_vehicles_only_best_first_and_inside_the_photograph(tmp_path: Path) -> None:
    file = write(
        tmp_path / "r.json",
        [
            result("a.png", [2, 3, 10, 5], score=0.5),
            result("a.png", [-5, -5, 20, 20], category=8, score=0.7),
            result("a.png", [1, 1, 5, 5], category=1),  # a person
            result("a.png", [40, 3, 10, 5]),  # outside
            result("b.png", [2, 3, 10, 5]),
        ],
    )
    (found,) = CocoDetector(file).detect([photo("a.png", "a")])
    assert [(box.box2d, box.type, box.score) for box in found] == [
        ((0.0, 0.0, 15.0, 15.0), "Truck", 0.7),
        ((2.0, 3.0, 12.0, 8.0), "Car", 0.5),
    ]
    assert make_detector(f"precomputed:{file}").detect([photo("c.png", "c")]) == [[]]


@pytest.mark.parametrize("image", ["x/000123.png", "000123.png", "000123", 123])
def test_photographs_are_known_by_path_name_id_or_number(tmp_path: Path, image: str | int) -> None:
    detector = CocoDetector(write(tmp_path / "r.json", [result(image, [2, 3, 10, 5])]))
    assert len(detector.detect([photo("x/000123.png", "000123")])[0]) == 1


def test_a_name_that_two_photographs_share_is_not_guessed(tmp_path: Path) -> None:
    detector = CocoDetector(write(tmp_path / "r.json", [result("000123.png", [2, 3, 10, 5])]))
    assert detector.detect([photo("x/000123.png", "x-000123-0a1b2c3d")]) == [[]]


def test_annotation_files_bring_their_own_names(tmp_path: Path) -> None:
    content = {
        "images": [{"id": 7, "file_name": "a.png"}],
        "categories": [{"id": 1, "name": "Pickup-Truck"}, {"id": 2, "name": "tree"}],
        "annotations": [
            {"image_id": 7, "category_id": 1, "bbox": [2, 3, 10, 5]},
            {"image_id": 7, "category_id": 2, "bbox": [2, 3, 10, 5]},
        ],
    }
    (found,) = CocoDetector(write(tmp_path / "r.json", content)).detect([photo("a.png", "a")])
    assert [(box.type, box.score) for box in found] == [("Truck", 1.0)]


BROKEN_RESULTS: dict[str, Any] = {
    "r.json: expected a list of results, or a dict": 3,
    "r.json: images must be a list of entries with id and file_name": {"annotations": []},
    "r.json [0]: expected a result with image_id": ["a"],
    "r.json [0]: image_id must be a text or a number, found None": [result("a", [1, 2, 3, 4]) | {"image_id": None}],
    "r.json [1]: bbox must be [x, y, width, height] in px, found [1, 2, 0, 4]": [
        result("a", [1, 2, 3, 4]),
        result("a", [1, 2, 0, 4]),
    ],
    "r.json [0]: bbox must be": [result("a", [1, 2, 3])],
    "r.json [0]: score must lie between 0 and 1, found 50": [result("a", [1, 2, 3, 4], score=50)],
}


@pytest.mark.parametrize(("message", "content"), BROKEN_RESULTS.items())
def test_malformed_results_are_named(tmp_path: Path, message: str, content: Any) -> None:
    with pytest.raises(InputError) as caught:
        read_results(str(write(tmp_path / "r.json", content)))
    assert message in str(caught.value)


def request(box: tuple[float, float, float, float]) -> SegmentRequest:
    window = Window(int(box[0]), int(box[1]), int(box[2] - box[0]), int(box[3] - box[1]))
    return SegmentRequest(image=IMAGE, window=window, box2d=box, frame_id="a", photo_path="a.png", patch_id="p")


def test_the_mask_of_the_result_with_the_same_box(tmp_path: Path) -> None:
    whole = np.zeros((20, 30), bool)
    whole[4:7, 3:9] = True
    other = np.ones((20, 30), bool)
    file = write(
        tmp_path / "r.json",
        [
            result("a.png", [2, 3, 10, 5], segmentation=encode_rle(whole), score=0.6),
            result("a.png", [15, 3, 10, 5], segmentation=encode_rle(other)),
            result("a.png", [0, 12, 8, 6], segmentation=[[1, 13, 5, 13, 5, 17, 1, 17]]),
        ],
    )
    found = make_segmenter(f"precomputed:{file}").segment(request((2.0, 3.0, 12.0, 8.0)))
    np.testing.assert_array_equal(found.car, whole[3:8, 2:12])
    assert (found.score, found.unknown.any()) == (0.6, False)
    polygon = CocoSegmenter(file).segment(request((0.0, 12.0, 8.0, 18.0)))
    expected = np.zeros((6, 8), bool)
    expected[1:5, 1:5] = True  # pixels whose centre lies inside
    np.testing.assert_array_equal(polygon.car, expected)
    with pytest.raises(InputError, match="no result of a overlaps its box"):
        CocoSegmenter(file).segment(request((20.0, 15.0, 25.0, 19.0)))


def test_masks_of_another_size_or_none_are_refused(tmp_path: Path) -> None:
    small = encode_rle(np.ones((5, 5), bool))
    file = write(tmp_path / "r.json", [result("a.png", [2, 3, 10, 5], segmentation=small)])
    with pytest.raises(InputError, match=r"must have the photograph's 30 x 20 pixels, it has 5 x 5"):
        CocoSegmenter(file).segment(request((2.0, 3.0, 12.0, 8.0)))
    file = write(tmp_path / "r.json", [result("a.png", [2, 3, 10, 5])])
    with pytest.raises(InputError, match=r"\[0\] segmentation: expected run lengths"):
        CocoSegmenter(file).segment(request((2.0, 3.0, 12.0, 8.0)))
