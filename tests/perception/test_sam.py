"""SAM by box prompts: a small one of random weights, saved and loaded as the hub's are, against direct use."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from carstudio.errors import InputError
from carstudio.perception.box_prompts import box_prompts
from carstudio.perception.results import PhotoSegmenter, Segmenter
from carstudio.perception.sam import SamSegmenter, open_sam
from carstudio.perception.specs import make_segmenter
from carstudio.perception.weights import DEFAULT_SAM
from perception.sam_cases import SHAPES, assert_same, boxes_of, direct, grown, photographs, requests_of
from perception.tiny_hub import IMAGENET, SAM_SIDE, save_processor, save_sam, save_sam2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sam")


@pytest.fixture(scope="module")
def network(folder: Path) -> nn.Module:
    return save_sam(folder)


@pytest.fixture
def segmenter(folder: Path, network: nn.Module) -> SamSegmenter:
    return SamSegmenter(name=str(folder), device="cpu")


@pytest.mark.parametrize("index", range(len(SHAPES)))
@pytest.mark.parametrize("multimask", [False, True])
def test_masks_are_those_of_transformers(
    segmenter: SamSegmenter, network: nn.Module, index: int, multimask: bool
) -> None:
    """transformers' own processor: sizes, box scaling, padding, up-sampling; one box at a time."""
    from transformers import SamProcessor
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil

    side = {"height": SAM_SIDE, "width": SAM_SIDE}
    processor = SamProcessor(SamImageProcessorPil(size={"longest_edge": SAM_SIDE}, pad_size=side))
    image = photographs()[index]
    requests = requests_of(image, boxes_of(SHAPES[index]))
    results = replace(segmenter, multimask=multimask).segment_all(requests)
    for request, result in zip(requests, results, strict=True):
        inputs = processor(images=image, input_boxes=[[list(request.box2d)]], return_tensors="pt")
        sizes = inputs.pop("original_sizes"), inputs.pop("reshaped_input_sizes")
        with torch.no_grad():
            output = network(**{k: v.float() for k, v in inputs.items()}, multimask_output=multimask)
        scores = output.iou_scores[0, 0]
        masks = processor.post_process_masks(output.pred_masks, *sizes, binarize=False)[0][0]
        best = int(scores.argmax())
        assert_same(result, masks[best].numpy(), float(scores[best]), request)
    assert any(0.02 < result.car.mean() < 0.98 for result in results)


@pytest.mark.parametrize("index", range(len(SHAPES)))
def test_masks_are_those_of_a_slow_loop(segmenter: SamSegmenter, network: nn.Module, index: int) -> None:
    image, shape = photographs()[index], SHAPES[index]
    requests = requests_of(image, boxes_of(shape))
    longer = max(shape)
    resized = (int(shape[0] * SAM_SIDE / longer + 0.5), int(shape[1] * SAM_SIDE / longer + 0.5))
    pixels = segmenter.open().preprocessing.pixels(image)[None]  # its own test: test_preprocessing.py
    for request, result in zip(requests, segmenter.segment_all(requests), strict=True):
        across, down = resized[1] / shape[1], resized[0] / shape[0]
        x0, y0, x1, y1 = request.box2d
        logits, score = direct(network, pixels, (x0 * across, y0 * down, x1 * across, y1 * down), multimask=False)
        assert_same(result, grown(logits, SAM_SIDE, resized, shape), score, request)


@pytest.mark.parametrize("batch", [None, 1, 2, 8])
def test_company_changes_nothing(segmenter: SamSegmenter, batch: int | None) -> None:
    segmenter = replace(segmenter, batch=batch)
    requests = requests_of(photographs()[0], boxes_of(SHAPES[0]))
    together = segmenter.segment_all(requests)
    for request, result, last in zip(requests, together, segmenter.segment_all(requests[::-1])[::-1], strict=True):
        alone = segmenter.segment(request)
        for other in (alone, last):
            np.testing.assert_array_equal(result.car, other.car)
            assert result.score == other.score  # to the bit
    assert len({result.score for result in together}) == 3
    assert segmenter.segment_all([]) == []


def test_one_look_at_the_photograph_serves_all_cars(segmenter: SamSegmenter, monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []
    encoder = segmenter.open().network.vision_encoder
    hook = encoder.register_forward_hook(lambda *_: looks.append(1))
    segmenter.segment_all(requests_of(photographs()[0], boxes_of(SHAPES[0])))
    hook.remove()
    assert looks == [1]


def test_where_a_nearer_car_is_nothing_is_known(segmenter: SamSegmenter) -> None:
    request = requests_of(photographs()[0], boxes_of(SHAPES[0]))[0]
    free = segmenter.segment(request)
    x0, y0, x1, y1 = request.box2d
    middle = (x0 + x1) / 2
    nearer = np.array([[middle, y0 - 9], [x1 + 9, y0 - 9], [x1 + 9, y1 + 9], [middle, y1 + 9]])
    result = segmenter.segment(replace(request, occluders=(nearer,)))
    u = request.window.x0 + np.arange(request.window.width) + 0.5
    assert not (result.car & result.unknown).any()
    assert not result.unknown[:, u < middle].any()
    assert result.unknown[:, u > middle].mean() > 0.5
    np.testing.assert_array_equal(result.car, free.car & ~result.unknown)
    assert result.score == free.score


def test_prompts_are_scaled_and_clipped() -> None:
    """A box over the whole photograph becomes the whole resized photograph, not the square."""
    prompts = box_prompts([(0.0, 0.0, 1242.0, 375.0), (-20.0, 100.0, 2000.0, 300.0)], (375, 1242), (309, 1024))
    expected = [[0, 0, 1024, 309], [0, 100 * 309 / 375, 1024, 300 * 309 / 375]]
    np.testing.assert_allclose(prompts.numpy(), expected, rtol=1e-6)


def test_settings_travel_to_workers_without_the_network(segmenter: SamSegmenter) -> None:
    assert isinstance(segmenter, Segmenter)
    assert isinstance(segmenter, PhotoSegmenter)
    segmenter.segment_all(requests_of(photographs()[0], boxes_of(SHAPES[0])))
    packed = pickle.dumps(segmenter)
    assert len(packed) < 1000
    assert pickle.loads(packed) == segmenter
    assert open_sam(segmenter.name, "cpu") is open_sam(segmenter.name, "cpu")


def test_half_precision_changes_little(segmenter: SamSegmenter) -> None:
    """The path of a GPU, on the CPU: only the image encoder, so that scores stay comparable."""
    requests = requests_of(photographs()[0], boxes_of(SHAPES[0]))
    exact = segmenter.segment_all(requests)
    rough = replace(segmenter, precision="float16").segment_all(requests)
    assert np.mean([np.mean(a.car == b.car) for a, b in zip(exact, rough, strict=True)]) > 0.97
    assert [a.score for a in exact] != [b.score for b in rough]


def test_specs(folder: Path, network: nn.Module) -> None:
    assert make_segmenter(f"sam:{folder}") == SamSegmenter(name=str(folder))
    assert SamSegmenter().name == DEFAULT_SAM


def test_other_models_are_refused(tmp_path: Path, folder: Path, network: nn.Module) -> None:
    save_sam2(tmp_path)
    with pytest.raises(InputError, match=r"sam:.*expected a model of type sam, found 'sam2'"):
        make_segmenter(f"sam:{tmp_path}")
    with pytest.raises(InputError, match=r"sam2:.*expected a model of type sam2 or sam2_video, found 'sam'"):
        make_segmenter(f"sam2:{folder}")


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"sam:.*no config.json in this folder"):
        make_segmenter(f"sam:{tmp_path}")


def test_out_of_reach_is_told_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    with pytest.raises(InputError, match=r"carstudio models download facebook/sam-vit-huge --out FOLDER"):
        make_segmenter("sam")
    with pytest.raises(InputError, match=r"carstudio models download facebook/sam2.1-hiera-large --out FOLDER"):
        make_segmenter("sam2")


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    save_sam(tmp_path)
    save_processor(
        tmp_path, size={"longest_edge": 128}, do_pad=True, pad_size={"height": 128, "width": 128}, **IMAGENET
    )
    segmenter = SamSegmenter(name=str(tmp_path), device="cpu")
    with pytest.raises(InputError, match=r"makes pictures of \(128, 128\) px, its network expects 64 x 64"):
        segmenter.segment_all(requests_of(photographs()[0], boxes_of(SHAPES[0])))
