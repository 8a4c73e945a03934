"""From a photograph to the pixels a hub model wants, as its `preprocessor_config.json` says.

Done here, because the image processors of `transformers` give other pixels with torchvision than without, and SAM 2's
does not exist without it. Same arithmetic as their PIL processors: resize 8-bit pixels, then scale and normalise.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from carstudio.errors import InputError

Size = tuple[int, int]  # height, width px
_BILINEAR = 2  # Pillow's number


@dataclass(frozen=True)
class Preprocessing:
    """How a network wants its photographs. Exactly one of `fixed`, `longest` alone, or `shortest` is given."""

    fixed: Size | None = None
    """Resize to this, whatever the aspect ratio."""
    shortest: int | None = None
    """Resize the shorter side to this, but the longer to at most `longest`, keeping the aspect ratio (DETR)."""
    longest: int | None = None
    """Without `shortest`: resize the longer side to this, keeping the aspect ratio (SAM)."""
    pad: Size | None = None
    """Zeros below and to the right up to this size (SAM)."""
    step: int = 1
    """Both sides are cut down to multiples of this (YOLOS)."""
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    scale: float = 1 / 255
    """Factor from grey values to what `mean` and `std` refer to."""
    resample: int = _BILINEAR
    """Pillow's number of the filter."""

    def resized(self, size: Size) -> Size:
        """Size of a photograph of `size` after resizing, before padding."""
        if self.fixed is not None:
            return self.fixed
        if self.shortest is None:
            assert self.longest is not None, "one way to resize is given"
            factor = self.longest / max(size)
            return max(1, int(size[0] * factor + 0.5)), max(1, int(size[1] * factor + 0.5))
        height, width = _by_shortest(size, self.shortest, self.longest)
        return max(self.step, height - height % self.step), max(self.step, width - width % self.step)

    def pixels(self, image: UInt8[np.ndarray, "height width 3"]) -> Float[Tensor, "3 rows columns"]:
        """What the network sees."""
        height, width = self.resized((image.shape[0], image.shape[1]))
        small = np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling(self.resample)))
        mean, std = np.array(self.mean, np.float32), np.array(self.std, np.float32)
        values = ((small.astype(np.float32) * np.float32(self.scale) - mean) / std).transpose(2, 0, 1)
        pixels = torch.from_numpy(np.ascontiguousarray(values))
        if self.pad is None:
            return pixels
        return torch.nn.functional.pad(pixels, (0, self.pad[1] - width, 0, self.pad[0] - height))


def _by_shortest(size: Size, shortest: int, longest: int | None) -> Size:
    """DETR's rule; the longer side is rounded down after the shorter was rounded to a whole number."""
    short, long = min(size), max(size)
    exact = float(shortest)
    if longest is not None and long / short * shortest > longest:
        exact = longest * short / long
        shortest = round(exact)
    if short == shortest:
        return size
    other = int(exact * long / short)
    return (shortest, other) if size[0] <= size[1] else (other, shortest)


def parse_preprocessing(config: Mapping[str, Any], *, name: str, step: int = 1) -> Preprocessing:
    """Read a `preprocessor_config.json`, today's form or one of the older ones; `InputError` when it asks for more."""
    normalises = config.get("do_normalize", "image_mean" in config)
    pad = config.get("pad_size") if config.get("do_pad") else None
    try:
        return Preprocessing(
            **_sizes(config),
            pad=None if pad is None else (int(pad["height"]), int(pad["width"])),
            step=step,
            mean=tuple(float(v) for v in config["image_mean"]) if normalises else (0.0, 0.0, 0.0),
            std=tuple(float(v) for v in config["image_std"]) if normalises else (1.0, 1.0, 1.0),
            scale=float(config.get("rescale_factor", 1 / 255)) if config.get("do_rescale", True) else 1.0,
            resample=int(Image.Resampling(config.get("resample", _BILINEAR))),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{name}: preprocessor_config.json: expected size (height and width, shortest_edge and longest_edge, or "
            f"longest_edge), image_mean, image_std and a Pillow filter, found {dict(config)}; take the file that "
            "belongs to the model"
        ) from error


def _sizes(config: Mapping[str, Any]) -> dict[str, Any]:
    size = config["size"]
    if isinstance(size, int):  # the oldest form, DETR's: the shorter side, and the longer one's limit beside it
        return {"shortest": size, "longest": int(config.get("max_size", 1333))}
    if size.get("height") and size.get("width"):
        return {"fixed": (int(size["height"]), int(size["width"]))}
    if size.get("shortest_edge"):
        longest = size.get("longest_edge") or config.get("max_size")
        return {"shortest": int(size["shortest_edge"]), "longest": None if longest is None else int(longest)}
    return {"longest": int(size["longest_edge"])}
