"""Slow second opinions on resizing, in float64 loops."""

import math

import numpy as np


def triangle_resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bilinear resizing that averages when it shrinks: a triangle as wide as an output pixel, centres at +0.5."""
    for axis, wanted in enumerate(size):
        image = np.moveaxis(_along_first(np.moveaxis(image, axis, 0), wanted), 0, axis)
    return image


def _along_first(image: np.ndarray, wanted: int) -> np.ndarray:
    step = image.shape[0] / wanted
    reach = max(1.0, step)
    rows = []
    for index in range(wanted):
        center = (index + 0.5) * step
        weights = np.array([max(0.0, 1 - abs(j + 0.5 - center) / reach) for j in range(image.shape[0])])
        rows.append(np.tensordot(weights / weights.sum(), image.astype(np.float64), axes=1))
    return np.stack(rows)


def bilinear(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bilinear interpolation without averaging, centres at +0.5, edges repeated."""
    rows, columns = image.shape
    out = np.zeros(size)
    for i in range(size[0]):
        for j in range(size[1]):
            y = min(max((i + 0.5) * rows / size[0] - 0.5, 0.0), rows - 1.0)
            x = min(max((j + 0.5) * columns / size[1] - 0.5, 0.0), columns - 1.0)
            y0, x0 = math.floor(y), math.floor(x)
            y1, x1 = min(y0 + 1, rows - 1), min(x0 + 1, columns - 1)
            v, u = y - y0, x - x0
            top = image[y0, x0] * (1 - u) + image[y0, x1] * u
            below = image[y1, x0] * (1 - u) + image[y1, x1] * u
            out[i, j] = top * (1 - v) + below * v
    return out
