"""Depth networks of transformers: a small Depth Anything of random weights, saved and loaded as the hub's are."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from carstudio.errors import InputError
from carstudio.perception.monocular_depth import estimate_inverse_depth, input_size, open_depth_network
from perception.tiny_hub import IMAGENET, photograph, save_processor, save_yolos, shake

RULES = {"size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14, "resample": 3}


def save_depth_anything(folder: Path, kind: str = "relative") -> nn.Module:
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    torch.manual_seed(0)
    backbone = Dinov2Config(
        hidden_size=16,
        num_hidden_layers=4,
        num_attention_heads=2,
        mlp_ratio=2,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = DepthAnythingConfig(
        backbone_config=backbone,
        patch_size=14,
        reassemble_hidden_size=16,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
        depth_estimation_type=kind,
        max_depth=80 if kind == "metric" else 1,
    )
    network = shake(DepthAnythingForDepthEstimation(config), std=0.2)
    network.head.conv3.bias.data.fill_(2.0)  # or the last ReLU makes most of it zero
    network.save_pretrained(folder)
    save_processor(folder, do_normalize=True, **RULES, **IMAGENET)
    return network


def by_transformers(network: nn.Module, image: np.ndarray) -> np.ndarray:
    from transformers.models.dpt.image_processing_pil_dpt import DPTImageProcessorPil

    processor = DPTImageProcessorPil(**RULES, **IMAGENET)
    pixels = processor(images=image, return_tensors="pt")["pixel_values"]
    with torch.no_grad():
        depth = network(pixel_values=pixels).predicted_depth
    return nn.functional.interpolate(depth[None], size=image.shape[:2], mode="bicubic", align_corners=False)[
        0, 0
    ].numpy()


@pytest.mark.parametrize("shape", [(90, 160), (120, 100)])
def test_depth_is_that_of_transformers(tmp_path, shape):
    network = save_depth_anything(tmp_path)
    image = photograph(*shape)
    found = estimate_inverse_depth(str(tmp_path), image, device="cpu")
    assert found.shape == shape
    assert found.std() > 1e-4
    np.testing.assert_allclose(found, by_transformers(network, image), rtol=1e-3, atol=1e-3 * found.std())


def test_metres_become_inverse_metres(tmp_path):
    network = save_depth_anything(tmp_path, "metric")
    image = photograph(90, 160)
    found = estimate_inverse_depth(str(tmp_path), image, device="cpu")
    assert open_depth_network(str(tmp_path), "cpu").is_metric
    np.testing.assert_allclose(found, 1 / by_transformers(network, image), rtol=1e-3)


def test_the_sides_are_scaled_as_little_as_one_of_them_allows():
    assert input_size((375, 1242), (518, 518), 14) == (518, 1722)  # Depth Anything on KITTI
    assert input_size((2000, 1000), (518, 518), 14) == (1036, 518)


def test_what_is_no_depth_network_is_refused(tmp_path):
    save_yolos(tmp_path)
    with pytest.raises(InputError, match=r"depth:.*expected a model of type .*depth_anything"):
        estimate_inverse_depth(str(tmp_path), photograph(64, 64), device="cpu")
    with pytest.raises(InputError, match="no such folder"):
        open_depth_network("/nowhere/at/all", "cpu")
