"""Detectors of transformers: small ones of random weights, saved and loaded as the hub's are."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from carstudio.errors import InputError
from carstudio.perception.results import Detection2D, Detector, Photo
from carstudio.perception.specs import make_detector
from carstudio.perception.suppression import without_doubles
from carstudio.perception.transformers_detector import (
    TransformersDetector,
    edges_px,
    open_network,
)
from carstudio.perception.vehicle_classes import vehicle_classes, vehicle_type
from carstudio.perception.weights import DEFAULT_DETECTOR
from perception.tiny_hub import photograph, save_dfine, save_processor, save_sam, save_yolos

SHAPES = [(90, 160), (120, 100), (90, 160), (64, 64)]


def photo(image: np.ndarray) -> Photo:
    return Photo(image=image, frame_id="f", path="f.png", intrinsics=(100.0, 100.0, 1.0, 1.0))


PHOTOS = [photo(photograph(*shape, seed=i)) for i, shape in enumerate(SHAPES)]


def by_transformers(network: nn.Module, kind: str, item: Photo, names: dict[int, str]) -> list[tuple[str, float, list]]:
    """(class name, score, box px) of every query's best class, by transformers' own processor and read-out."""
    from transformers.models.rt_detr.image_processing_pil_rt_detr import RTDetrImageProcessorPil
    from transformers.models.yolos.image_processing_pil_yolos import YolosImageProcessorPil

    if kind == "dfine":
        processor = RTDetrImageProcessorPil(size={"height": 64, "width": 64})
    else:
        processor = YolosImageProcessorPil(size={"shortest_edge": 64, "longest_edge": 110})
    pixels = processor(images=item.image, return_tensors="pt")["pixel_values"]
    with torch.no_grad():
        output = network(pixel_values=pixels)
    found = processor.post_process_object_detection(output, threshold=0.0, target_sizes=[item.image.shape[:2]])[0]
    best: dict[tuple, tuple[str, float, list]] = {}
    for score, label, box in zip(found["scores"], found["labels"], found["boxes"], strict=True):  # surest first
        best.setdefault(tuple(box.tolist()), (names[int(label)], float(score), box.tolist()))
    return list(best.values())


@pytest.fixture(params=["dfine", "yolos"])
def saved(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, nn.Module, Path]:
    save = {"dfine": save_dfine, "yolos": save_yolos}[request.param]
    return request.param, save(tmp_path), tmp_path


def test_boxes_are_those_of_transformers(saved: tuple[str, nn.Module, Path]) -> None:
    kind, network, folder = saved
    detector = TransformersDetector(str(folder), device="cpu", threshold=0.05, same_iou=1.0)
    assert isinstance(detector, Detector)
    names = network.config.id2label
    total = 0
    for item, boxes in zip(PHOTOS, detector.detect(PHOTOS), strict=True):
        height, width = item.image.shape[:2]
        expected = []
        theirs = by_transformers(network, kind, item, names)
        # they keep as many answers as there are queries, and D-FINE's queries may give several each: the surest ones
        least = min(score for _, score, _ in theirs) if kind == "dfine" else 0.05
        boxes = [b for b in boxes if b.score >= least - 1e-6]
        for name, score, box in theirs:
            x0, y0, x1, y1 = np.clip(box, 0, [width, height, width, height])
            if name in ("car", "truck", "bus") and score > 0.05 and x1 > x0 and y1 > y0:
                expected.append((-score, name.capitalize(), [x0, y0, x1, y1]))
        expected.sort(key=lambda row: row[0])
        assert [b.type for b in boxes] == [row[1] for row in expected]
        # float32 of one network against itself; px of 160
        np.testing.assert_allclose([b.score for b in boxes], [-row[0] for row in expected], atol=1e-5)
        np.testing.assert_allclose([b.box2d for b in boxes], [row[2] for row in expected], atol=1e-3)
        total += len(boxes)
    assert total > 8


def test_company_and_order_change_nothing(saved: tuple[str, nn.Module, Path]) -> None:
    _, _, folder = saved
    for batch in (1, 3):
        detector = TransformersDetector(str(folder), device="cpu", threshold=0.05, batch=batch)
        together = detector.detect(PHOTOS)
        assert [detector.detect([item])[0] for item in PHOTOS] == together  # to the bit
        assert detector.detect(PHOTOS[::-1]) == together[::-1]
    assert detector.detect([]) == []


def test_boxes_are_inside_and_the_surest_come_first(saved: tuple[str, nn.Module, Path]) -> None:
    _, _, folder = saved
    for item, boxes in zip(PHOTOS, TransformersDetector(str(folder), threshold=0.2).detect(PHOTOS), strict=True):
        height, width = item.image.shape[:2]
        scores = [b.score for b in boxes]
        assert scores == sorted(scores, reverse=True)
        assert all(0.2 < s <= 1 for s in scores)
        for x0, y0, x1, y1 in (b.box2d for b in boxes):
            assert 0 <= x0 < x1 <= width
            assert 0 <= y0 < y1 <= height


def test_settings_travel_to_workers_without_the_network(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    detector = TransformersDetector(str(tmp_path), device="cpu", threshold=0.05)
    detector.detect(PHOTOS[:1])
    packed = pickle.dumps(detector)
    assert len(packed) < 1000
    assert pickle.loads(packed).detect(PHOTOS[:1]) == detector.detect(PHOTOS[:1])


def test_a_network_is_loaded_once(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    assert open_network(str(tmp_path), "cpu") is open_network(str(tmp_path), "cpu")


def test_half_precision_moves_boxes_a_little(tmp_path: Path) -> None:
    """The path of a GPU, on the CPU; random weights amplify rounding and may choose other queries."""
    save_dfine(tmp_path)
    exact = TransformersDetector(str(tmp_path), device="cpu", threshold=0.3).detect(PHOTOS[:1])[0]
    rough = TransformersDetector(str(tmp_path), device="cpu", threshold=0.3, precision="float16").detect(PHOTOS[:1])[0]
    assert exact != rough
    nearest = [min(np.abs(np.subtract(a.box2d, b.box2d)).max() for b in rough) for a in exact]
    assert np.median(nearest) < 8


def test_edges_are_continuous_pixels() -> None:
    """A box over the whole photograph ends at its edges, width and height; beyond is clipped."""
    boxes = np.array([[0.5, 0.5, 1.0, 1.0], [0.25, 0.5, 0.5, 0.2], [0.9, 0.1, 0.4, 0.4]])
    expected = [[0, 0, 200, 100], [0, 40, 100, 60], [140, 0, 200, 30]]
    np.testing.assert_allclose(edges_px(boxes, 200, 100), expected, atol=1e-9)


def test_of_two_boxes_of_one_vehicle_the_surer_stays() -> None:
    edges = np.array([[0, 0, 10, 10], [0, 0, 10, 9], [0, 0, 10, 5], [20, 0, 30, 10]], np.float64)
    assert without_doubles(edges, [1, 0, 3, 2], 0.8) == [1, 3, 2]
    assert without_doubles(edges, [1, 0, 3, 2], 0.95) == [1, 0, 3, 2]
    assert without_doubles(edges, [], 0.8) == []


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("car", "Car"),
        ("Pickup Truck", "Truck"),
        ("car_(automobile)", "Car"),
        ("SUV", "Car"),
        ("Van", "Van"),
        ("bus", "Bus"),
        ("train", None),
        ("carpet", None),
        ("N/A", None),
        ("motorcycle", None),
    ],
)
def test_names_of_data_sets(name: str, expected: str | None) -> None:
    assert vehicle_type(name) == expected


def test_classes_come_from_the_models_own_names() -> None:
    assert vehicle_classes({0: "truck", 5: "Dog", 7: "car"}, model="m") == {0: "Truck", 7: "Car"}


def test_a_detector_of_other_things_is_refused(tmp_path: Path) -> None:
    save_dfine(tmp_path, names=("cat", "dog", "zebra"))
    with pytest.raises(InputError) as told:
        make_detector(f"transformers:{tmp_path}")
    for part in (str(tmp_path), "none of its 3 classes is a vehicle", "cat, dog, zebra", "COCO"):
        assert part in str(told.value)


def test_a_folder_that_is_no_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no config.json in this folder; expected what save_pretrained writes"):
        make_detector(f"transformers:{tmp_path}")
    with pytest.raises(InputError, match=r"transformers:/no/such/folder: no such folder"):
        make_detector("transformers:/no/such/folder")


def test_another_kind_of_model_is_refused(tmp_path: Path) -> None:
    save_sam(tmp_path)
    with pytest.raises(InputError, match=r"expected a model of type .*d_fine.*, found 'sam'"):
        make_detector(f"transformers:{tmp_path}")


def test_missing_weights_are_refused(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(InputError, match=r"no weights that can be read .* expected model.safetensors"):
        make_detector(f"transformers:{tmp_path}")


def test_a_part_of_the_weights_is_refused(tmp_path: Path) -> None:
    """transformers itself would go on with random numbers."""
    from safetensors.torch import load_file, save_file

    save_dfine(tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    kept = {key: value for key, value in weights.items() if "enc_score_head" not in key}
    assert len(kept) < len(weights)
    save_file(kept, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"lack \d that the network has \(.*enc_score_head"):
        make_detector(f"transformers:{tmp_path}")


def test_damaged_weights_are_refused(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    whole = (tmp_path / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[:1000])
    with pytest.raises(InputError, match=r"cannot be loaded|no weights that can be read"):
        make_detector(f"transformers:{tmp_path}")


def test_weights_that_are_not_numbers_are_refused(tmp_path: Path) -> None:
    network = save_dfine(tmp_path)
    with torch.no_grad():
        next(network.model.decoder.layers.parameters()).fill_(float("nan"))
    network.save_pretrained(tmp_path)
    with pytest.raises(InputError, match="NaN"):
        TransformersDetector(str(tmp_path), device="cpu").detect(PHOTOS[:1])


@pytest.mark.parametrize("kind", ["d_fine", "of_its_own"])
def test_a_models_own_program_is_never_run(tmp_path: Path, kind: str) -> None:
    save_dfine(tmp_path)
    (tmp_path / "own.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\nclass C: pass\n")
    config = json.loads((tmp_path / "config.json").read_text())
    parts = {"AutoConfig": "own.C", "AutoModelForObjectDetection": "own.C", "AutoImageProcessor": "own.C"}
    (tmp_path / "config.json").write_text(json.dumps({**config, "model_type": kind, "auto_map": parts}))
    if kind == "d_fine":  # known: loaded by transformers' own program
        make_detector(f"transformers:{tmp_path}")
    else:
        with pytest.raises(InputError, match="custom code"):
            make_detector(f"transformers:{tmp_path}")
    assert not (tmp_path / "ran").exists()


def test_no_preprocessing_is_refused(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    (tmp_path / "preprocessor_config.json").unlink()
    with pytest.raises(InputError, match=r"no preprocessor_config.json, .* copy it"):
        make_detector(f"transformers:{tmp_path}")


def test_names_that_do_not_fit_the_answers_are_refused(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    assert set(config["id2label"]) == {"0", "1", "2", "3"}
    save_processor(tmp_path, size={"height": 64, "width": 64})
    loaded = open_network(str(tmp_path), "cpu")
    with pytest.raises(InputError, match=r"expected 4 logits per box, .* or one more, found 7"):
        loaded.confidence(torch.zeros(2, 7))


def test_out_of_reach_is_told_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(InputError) as told:
        make_detector("transformers:nobody/no-such-detector")
    for part in ("transformers:nobody/no-such-detector", "carstudio models download nobody/no-such-detector --out"):
        assert part in str(told.value)


def test_the_kind_alone_means_the_default() -> None:
    assert TransformersDetector().name == DEFAULT_DETECTOR


def test_answers_are_records(tmp_path: Path) -> None:
    save_dfine(tmp_path)
    boxes = TransformersDetector(str(tmp_path), device="cpu", threshold=0.05).detect(PHOTOS[:1])[0]
    assert boxes
    assert all(isinstance(box, Detection2D) for box in boxes)
