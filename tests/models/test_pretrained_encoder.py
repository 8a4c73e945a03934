"""The paper's encoder with weights from a folder, as from the hub: the same code path, a model saved on the spot."""

import time
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from transformers import ResNetConfig, ResNetModel

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.models.encoders import EncoderConfig, ResNet34Encoder, build_encoder, load_imagenet
from carstudio.models.interface import PatchBatch


def save_resnet(folder: Path, **changes: object) -> ResNetModel:
    """A ResNet of ResNet-34's sizes with random weights and lively normalisation, saved as the hub's models are."""
    torch.manual_seed(3)
    sizes = {"depths": [3, 4, 6, 3], "hidden_sizes": [64, 128, 256, 512], "layer_type": "basic"}
    model = ResNetModel(ResNetConfig(**{**sizes, **changes}))
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
            nn.init.normal_(module.running_mean, std=0.1)
    model.save_pretrained(folder)
    return model.eval()


def photos(image: Tensor) -> PatchBatch:
    """Pictures as encoders get them; nothing but the picture matters to these."""
    count, side = len(image), image.shape[-1]
    box = Box3D(torch.zeros(count, 3), torch.ones(count, 3), torch.eye(3).expand(count, 3, 3))
    camera = Camera(torch.ones(count, 4), side, side)
    return PatchBatch(image, torch.zeros(count, side, side), camera, box, ("a",) * count)


def features_by_transformers(model: ResNetModel, image: Tensor) -> Tensor:
    """As released: relu(conv1) and the first three stages, up-sampled to the first's size, concatenated, max-pooled."""
    pixels = image * 2 - 1
    stem: list[Tensor] = []
    hook = model.embedder.embedder.register_forward_hook(lambda module, inputs, output: stem.append(output))
    stages = model(pixels, output_hidden_states=True).hidden_states
    hook.remove()
    side = stem[0].shape[-1]
    grown = [nn.Upsample(size=(side, side), mode="bilinear", align_corners=True)(part) for part in stages[1:4]]
    maps = torch.cat([stem[0], *grown], dim=1)
    return maps.flatten(2).max(dim=-1).values


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)


@torch.no_grad()
def test_weights_and_features_are_those_of_the_saved_model(tmp_path: Path) -> None:
    theirs = save_resnet(tmp_path)
    config = EncoderConfig(pretrained=str(tmp_path))
    ours = build_encoder(config)
    before = ours(photos(torch.zeros(1, 3, 64, 64)))
    assert load_imagenet(ours, config) == f"ImageNet weights of {tmp_path}"
    ours.eval()
    image = torch.rand(2, 3, 64, 64)
    features = ours(photos(image))
    assert features.shape == (2, 512)
    assert not torch.allclose(before, features[:1])
    # the same float32 operations; only the order of sums may differ
    torch.testing.assert_close(features, features_by_transformers(theirs, image), atol=1e-4, rtol=1e-4)
    weights = dict(theirs.named_parameters())
    for name, weight in ours.stages.named_parameters():
        assert torch.equal(weight, weights[f"encoder.stages.{name}"])


def test_no_weights_there_is_said_in_words(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = EncoderConfig(pretrained=str(tmp_path / "nowhere"))
    message = load_imagenet(build_encoder(config), config)
    assert message.startswith("random weights")
    assert str(tmp_path / "nowhere") in message
    assert "random weights" in caplog.text


@pytest.mark.usefixtures("offline")
def test_a_hub_out_of_reach_is_told_at_once() -> None:
    config = EncoderConfig(pretrained="microsoft/no-such-resnet")
    started = time.monotonic()
    assert load_imagenet(build_encoder(config), config).startswith("random weights (microsoft/no-such-resnet")
    assert time.monotonic() - started < 30  # it does not wait for a network that is not there


def test_another_architecture_is_refused_by_name(tmp_path: Path) -> None:
    save_resnet(tmp_path, depths=[2, 2, 2, 2])
    config = EncoderConfig(pretrained=str(tmp_path))
    with pytest.raises(InputError, match="ResNet-34"):
        load_imagenet(build_encoder(config), config)


def test_the_small_encoder_has_nothing_to_load() -> None:
    config = EncoderConfig(kind="small", pretrained=None, num_features=64)
    encoder = build_encoder(config)
    assert not isinstance(encoder, ResNet34Encoder)
    assert load_imagenet(encoder, config) == "random weights"
