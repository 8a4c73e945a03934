"""Depth of one photograph by a network of `transformers` (Depth Anything, DPT, ZoeDepth, Depth Pro and their kin).

Most of them answer with inverse depth of unknown scale and shift, some with metres. Both are handed on as inverse
depth, which who knows the ground or LiDAR points makes metric.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import nn

from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.hub import load_from_hub
from carstudio.perception.hub_models import low_precision, read_config, read_network, read_preprocessing
from carstudio.perception.preprocessing import Preprocessing, Size

SPEC = "depth"
_METRIC = ("zoedepth", "depth_pro")  # these answer with metres; Depth Anything says so in its config


@dataclass(frozen=True)
class LoadedDepth:
    """A network with what is needed to ask it."""

    network: nn.Module
    preprocessing: Preprocessing
    keeps_aspect: bool
    multiple_of: int
    is_metric: bool
    device: torch.device
    name: str


@lru_cache(maxsize=1)
def open_depth_network(name: str, device: str = "auto") -> LoadedDepth:
    """Load a network by its hub name or folder, once per process; `InputError` when there is none."""
    from transformers import AutoModelForDepthEstimation
    from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

    config = read_config(name, tuple(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES), spec=SPEC)
    preprocessing = read_preprocessing(name, spec=SPEC)
    keeps_aspect, multiple_of = _resize_rule(name)
    network = read_network(AutoModelForDepthEstimation.from_pretrained, name, spec=SPEC)
    is_metric = config.model_type in _METRIC or getattr(config, "depth_estimation_type", "relative") == "metric"
    place = pick_device(device)
    return LoadedDepth(network.to(place), preprocessing, keeps_aspect, multiple_of, is_metric, place, name)


def estimate_inverse_depth(
    name: str, image: UInt8[np.ndarray, "height width 3"], *, device: str = "auto"
) -> Float[np.ndarray, "height width"]:
    """Inverse depth, larger is nearer: 1 / m for metric networks, of unknown scale and shift for others."""
    loaded = open_depth_network(name, device)
    preprocessing = loaded.preprocessing
    if loaded.keeps_aspect and preprocessing.fixed is not None:
        preprocessing = replace(
            preprocessing, fixed=input_size((image.shape[0], image.shape[1]), preprocessing.fixed, loaded.multiple_of)
        )
    pixels = preprocessing.pixels(image)[None].to(loaded.device)
    with torch.inference_mode(), low_precision("auto", loaded.device):
        answer = loaded.network(pixel_values=pixels).predicted_depth.float().cpu()
    if not bool(torch.isfinite(answer).all()):
        raise InputError(f"{SPEC}:{name}: the network answers with NaN; are its weights damaged?")
    size = (image.shape[0], image.shape[1])
    depth = torch.nn.functional.interpolate(answer[:, None], size=size, mode="bicubic", align_corners=False)[0, 0]
    values: Float[np.ndarray, "height width"] = depth.double().numpy()
    return 1 / np.maximum(values, 1e-2) if loaded.is_metric else values


def _resize_rule(name: str) -> tuple[bool, int]:
    """Whether the photograph keeps its aspect ratio, and what its sides are multiples of (DPT, Depth Anything)."""
    from transformers.image_processing_base import ImageProcessingMixin

    config, _ = load_from_hub(partial(ImageProcessingMixin.get_image_processor_dict), name)
    return bool(config.get("keep_aspect_ratio")), max(1, int(config.get("ensure_multiple_of") or 1))


def input_size(photo: Size, target: Size, multiple_of: int) -> Size:
    """Size of the network's input for DPT's rule: scaled as little as one side's target allows, in whole patches."""
    scales = [wanted / side for wanted, side in zip(target, photo, strict=True)]
    scale = min(scales, key=lambda value: abs(1 - value))
    height, width = (max(multiple_of, round(scale * side / multiple_of) * multiple_of) for side in photo)
    return height, width
