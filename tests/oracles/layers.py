"""Several objects on the same rays, merged sample by sample in plain Python: the yardstick of `scene.layers`."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.scene.layers import TracedObject


def merge_layers_plainly(
    objects: Sequence[TracedObject], background_m: Float[Tensor, " all_pixels"]
) -> tuple[Float[Tensor, "object all_pixels"], Float[Tensor, "all_pixels 3"]]:
    """The yardstick: pixel by pixel, sample by sample. Weights of all objects, and the sum of their colours."""
    weights = torch.zeros(len(objects), len(background_m), dtype=torch.float64)
    rgb = torch.zeros(len(background_m), 3, dtype=torch.float64)
    samples: list[list[tuple[float, int, float, Tensor]]] = [[] for _ in background_m]
    for number, traced in enumerate(objects):
        for ray, pixel in enumerate(traced.pixels.tolist()):
            part = traced.segments
            for distance, alpha, colour in zip(
                part.distance_m[0, ray].tolist(), part.alpha[0, ray].tolist(), part.rgb[0, ray], strict=True
            ):
                samples[pixel].append((distance, number, alpha, colour))
    for pixel, along in enumerate(samples):
        light = 1.0
        for distance, number, alpha, colour in sorted(along, key=lambda sample: sample[0]):
            if distance >= float(background_m[pixel]):
                break
            weights[number, pixel] += light * alpha
            rgb[pixel] += light * alpha * colour.double()
            light *= 1 - alpha
    return weights, rgb
