"""The reference of DD3D: outputs of the original for weights made by a recipe, and what we give for the same.

See README.md of the folder that the fixture `dd3d_data` finds.
"""

import importlib.util
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from carstudio.geometry.camera import Camera
from carstudio.images import read_image
from carstudio.perception.dd3d.model import Backbone

SHORT_NAME: dict[Backbone, str] = {"dla34": "dla34", "v2-99": "v99"}
FINEST_STRIDE: dict[Backbone, int] = {"dla34": 8, "v2-99": 4}


def recipe_weights(folder: Path, backbone: Backbone, constants: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The recipe's weights in the order of the original's state dict, each with its checksum compared.

    What the recipe does not make is taken from `constants`, a state dict of ours.
    """
    spec = importlib.util.spec_from_file_location("dd3d_recipe", folder / "recipe.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    weights = {}
    for entry in json.loads((folder / f"keys_{SHORT_NAME[backbone]}.json").read_text()):
        value = module.recipe(entry["key"], entry["shape"], FINEST_STRIDE[backbone])
        assert (value is not None) == entry["from_recipe"]
        tensor = constants[entry["key"]] if value is None else torch.from_numpy(np.asarray(value))
        assert list(tensor.shape) == entry["shape"]
        assert str(tensor.dtype) == f"torch.{entry['dtype']}"
        assert zlib.crc32(tensor.numpy().tobytes()) == entry["crc32"], entry["key"]
        weights[entry["key"]] = tensor
    return weights


@dataclass(frozen=True)
class Reference:
    """A photo with its camera and what the original makes of it, by name."""

    image: torch.Tensor
    camera: Camera
    arrays: dict[str, np.ndarray]


def real_reference(folder: Path, backbone: Backbone) -> Reference:
    """KITTI's frame 000008 at the network's size."""
    with np.load(folder / f"golden_{SHORT_NAME[backbone]}_real.npz") as arrays:
        expected = dict(arrays)
    rgb = read_image(folder / "real_000008_resized_384.png")
    image = torch.from_numpy(np.ascontiguousarray(rgb[..., ::-1].transpose(2, 0, 1)))
    assert zlib.crc32(image.numpy().tobytes()) == int(expected["in_u8_crc32"][0])
    k = torch.from_numpy(expected["intrinsics_in"])
    camera = Camera(torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2]]), rgb.shape[1], rgb.shape[0])
    return Reference(image, camera, expected)


def synthetic_input() -> tuple[torch.Tensor, Camera]:
    """The second input: blocks of colour with noise, of another size, which needs no padding."""
    random = np.random.RandomState(1234)
    blocks = np.kron(random.randint(0, 256, (16, 32, 3)), np.ones((8, 8, 1)))
    bgr = np.clip(blocks + random.randint(-20, 21, (128, 256, 3)), 0, 255).astype(np.uint8)
    image = torch.from_numpy(np.ascontiguousarray(bgr.transpose(2, 0, 1)))
    return image, Camera(torch.tensor([200.0, 190.0, 130.0, 62.0]), 256, 128)
