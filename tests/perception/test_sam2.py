"""SAM 2 by box prompts: a small one of random weights; its own processor needs torchvision, so the oracle is ours."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from carstudio.perception.results import PhotoSegmenter, Segmenter
from carstudio.perception.sam2 import Sam2Segmenter
from carstudio.perception.specs import make_segmenter
from carstudio.perception.weights import DEFAULT_SAM2
from oracles.resize import bilinear, triangle_resize
from perception.sam_cases import SHAPES, assert_same, boxes_of, direct, photographs, requests_of
from perception.tiny_hub import IMAGENET, SAM_SIDE, save_sam2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sam2")


@pytest.fixture(scope="module")
def network(folder: Path) -> nn.Module:
    return save_sam2(folder)


@pytest.fixture
def segmenter(folder: Path, network: nn.Module) -> Sam2Segmenter:
    return Sam2Segmenter(name=str(folder), device="cpu")


@pytest.mark.parametrize("index", range(len(SHAPES)))
@pytest.mark.parametrize("multimask", [False, True])
def test_masks_are_those_of_a_slow_loop(
    segmenter: Sam2Segmenter, network: nn.Module, index: int, multimask: bool
) -> None:
    """Resizing to grey values and up-sampling in loops, one box and one whole pass of the network at a time."""
    image, (height, width) = photographs()[index], SHAPES[index]
    pixels = segmenter.open().preprocessing.pixels(image)[None]
    grey = triangle_resize(image, (SAM_SIDE, SAM_SIDE))
    mean, std = np.array(IMAGENET["image_mean"]), np.array(IMAGENET["image_std"])
    expected = ((grey / 255 - mean) / std).transpose(2, 0, 1)
    np.testing.assert_allclose(pixels[0], expected, atol=1.01 / 255 / 0.224)  # Pillow rounds to grey values
    requests = requests_of(image, boxes_of(SHAPES[index]))
    results = replace(segmenter, multimask=multimask).segment_all(requests)
    for request, result in zip(requests, results, strict=True):
        x0, y0, x1, y1 = request.box2d
        box = x0 * SAM_SIDE / width, y0 * SAM_SIDE / height, x1 * SAM_SIDE / width, y1 * SAM_SIDE / height
        logits, score = direct(network, pixels, box, multimask)
        assert_same(result, bilinear(logits, (height, width)), score, request)
    assert any(0.02 < result.car.mean() < 0.98 for result in results)


def test_the_hubs_video_models_give_the_masks_of_their_image_part(tmp_path: Path) -> None:
    """facebook/sam2.1-* are saved as video models: their memory is left out, the rest is loaded to the last weight."""
    from transformers import Sam2Model

    video = save_sam2(tmp_path, is_video=True)
    loaded = Sam2Segmenter(name=str(tmp_path), device="cpu").open().network
    assert isinstance(loaded, Sam2Model)
    theirs = video.state_dict()
    assert all(torch.equal(weight, theirs[name]) for name, weight in loaded.state_dict().items())
    image = photographs()[0]
    segmenter = make_segmenter(f"sam2:{tmp_path}")
    assert isinstance(segmenter, PhotoSegmenter)
    results = segmenter.segment_all(requests_of(image, boxes_of(SHAPES[0])))
    assert len({result.score for result in results}) == 3


@pytest.mark.parametrize("batch", [None, 2, 8])
def test_company_changes_nothing(segmenter: Sam2Segmenter, batch: int | None) -> None:
    segmenter = replace(segmenter, batch=batch)
    requests = requests_of(photographs()[1], boxes_of(SHAPES[1]))
    for request, result in zip(requests, segmenter.segment_all(requests), strict=True):
        alone = segmenter.segment(request)
        np.testing.assert_array_equal(result.car, alone.car)
        assert result.score == alone.score  # to the bit


def test_specs(folder: Path, network: nn.Module) -> None:
    segmenter = make_segmenter(f"sam2:{folder}")
    assert segmenter == Sam2Segmenter(name=str(folder))
    assert isinstance(segmenter, Segmenter)
    assert Sam2Segmenter().name == DEFAULT_SAM2
