"""Pixels for networks against the PIL processors of transformers and a slow loop of our own."""

from typing import Any

import numpy as np
import pytest
import torch

from carstudio.errors import InputError
from carstudio.perception.preprocessing import Preprocessing, parse_preprocessing
from oracles.resize import triangle_resize
from perception.tiny_hub import IMAGENET, photograph

SHAPES = [(37, 61), (90, 50), (64, 64), (48, 160), (300, 40)]


def by_transformers(kind: str, config: dict[str, Any], image: np.ndarray) -> np.ndarray:
    from transformers.models.detr.image_processing_pil_detr import DetrImageProcessorPil
    from transformers.models.rt_detr.image_processing_pil_rt_detr import RTDetrImageProcessorPil
    from transformers.models.sam.image_processing_pil_sam import SamImageProcessorPil
    from transformers.models.yolos.image_processing_pil_yolos import YolosImageProcessorPil

    processors = {
        "detr": DetrImageProcessorPil,
        "rt_detr": RTDetrImageProcessorPil,
        "sam": SamImageProcessorPil,
        "yolos": YolosImageProcessorPil,
    }
    processor = processors[kind](**config)
    return np.asarray(processor(images=image, return_tensors="np")["pixel_values"][0])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("kind", "config"),
    [
        ("rt_detr", {"size": {"height": 48, "width": 80}, "do_normalize": False, "do_pad": False}),
        ("rt_detr", {"size": {"height": 64, "width": 64}, "do_normalize": True, **IMAGENET, "resample": 3}),
        ("detr", {"size": {"shortest_edge": 50, "longest_edge": 83}, "do_normalize": True, **IMAGENET}),
        ("yolos", {"size": {"shortest_edge": 50, "longest_edge": 83}, "do_normalize": True, **IMAGENET}),
        (
            "sam",
            {
                "size": {"longest_edge": 64},
                "do_pad": True,
                "pad_size": {"height": 64, "width": 64},
                "do_normalize": True,
                **IMAGENET,
            },
        ),
    ],
)
def test_pixels_are_those_of_transformers(kind: str, config: dict[str, Any], shape: tuple[int, int]) -> None:
    if kind == "yolos" and min(shape) / max(shape) < 0.2:
        return  # theirs would be 0 px wide
    image = photograph(*shape)
    ours = parse_preprocessing(config, name="a model", step=16 if kind == "yolos" else 1).pixels(image)
    theirs = by_transformers(kind, config, image)
    assert ours.dtype == torch.float32
    assert tuple(ours.shape) == theirs.shape
    np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-5)  # one rounding of float32 may differ


@pytest.mark.parametrize("shape", SHAPES[:4])
def test_pixels_are_those_of_a_slow_loop(shape: tuple[int, int]) -> None:
    """The square of SAM 2, whose own processor needs torchvision."""
    image = photograph(*shape)
    config = {"size": {"height": 40, "width": 40}, "do_normalize": True, **IMAGENET}
    ours = parse_preprocessing(config, name="a model").pixels(image).numpy()
    mean, std = (np.array(IMAGENET[key])[:, None, None] for key in ("image_mean", "image_std"))
    expected = (triangle_resize(image, (40, 40)).transpose(2, 0, 1) / 255 - mean) / std
    # Pillow rounds to whole grey values after each direction: at most one grey value, 1 / 255 / 0.224
    np.testing.assert_allclose(ours, expected, atol=1.01 / 255 / 0.224)


def test_old_forms_of_the_sizes_mean_the_same() -> None:
    old = parse_preprocessing({"size": 800, "max_size": 1333, **IMAGENET}, name="a model")
    new = parse_preprocessing({"size": {"shortest_edge": 800, "longest_edge": 1333}, **IMAGENET}, name="a model")
    assert old == new
    assert old.resized((375, 1242)) == (402, 1333)
    assert old.scale == 1 / 255
    assert old.mean == (0.485, 0.456, 0.406)


def test_sizes_are_those_of_transformers() -> None:
    from transformers.image_transforms import get_size_with_aspect_ratio

    random = np.random.default_rng(0)
    for height, width, shortest, more in random.integers(20, 1500, (3000, 4)).tolist():
        ours = Preprocessing(shortest=shortest, longest=shortest + more).resized((height, width))
        theirs = get_size_with_aspect_ratio((height, width), shortest, shortest + more)
        assert ours == (max(1, theirs[0]), max(1, theirs[1])), (height, width, shortest, more)


def test_padding_is_asked_for_twice() -> None:
    """Many files carry a `pad_size` that their `do_pad` switches off."""
    config = {"size": {"height": 8, "width": 8}, "pad_size": {"height": 9, "width": 9}}
    assert parse_preprocessing({**config, "do_pad": False}, name="a").pad is None
    assert parse_preprocessing({**config, "do_pad": True}, name="a").pad == (9, 9)


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"size": {}},
        {"size": {"height": 8, "width": 8}, "do_normalize": True},
        {"size": "big"},
        {"size": {"height": 8, "width": 8}, "resample": 77},
    ],
)
def test_what_cannot_be_read_is_told(config: dict[str, Any]) -> None:
    with pytest.raises(
        InputError, match=r"a-model: preprocessor_config.json: expected size .* found \{.*take the file"
    ):
        parse_preprocessing(config, name="a-model")


def test_padding_is_zero_after_normalising() -> None:
    preprocessing = Preprocessing(longest=32, pad=(32, 32), mean=(0.5,) * 3, std=(0.5,) * 3)
    pixels = preprocessing.pixels(photograph(20, 40))
    assert preprocessing.resized((20, 40)) == (16, 32)
    assert torch.all(pixels[:, 16:] == 0)
    assert not torch.all(pixels[:, :16] == 0)
