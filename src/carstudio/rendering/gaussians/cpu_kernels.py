"""Whole-number work that NumPy does several times as fast as torch on CPUs; elsewhere torch does it."""

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor


def places_of(chosen: Bool[Tensor, "*shape"]) -> Int[Tensor, " place"]:
    """Flat places of what is true."""
    if chosen.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(chosen.numpy()))
    return chosen.flatten().nonzero().squeeze(-1)


def places_of_negative(values: Tensor) -> Int[Tensor, " place"]:
    """Flat places of negative values and of what is no number."""
    if values.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(~(values.numpy() >= 0)))
    return places_of(~(values >= 0))


def quotient(numbers: Int[Tensor, "*shape"], divisor: int) -> Int[Tensor, "*shape"]:
    """Whole quotients of numbers that are not negative: NumPy divides by multiplying."""
    if numbers.device.type == "cpu":
        return torch.from_numpy(numbers.numpy() // divisor)
    return torch.div(numbers, divisor, rounding_mode="floor")


def first_sorted(keys: Int[Tensor, "row key"], most: int) -> Int[Tensor, "row most"]:
    """The smallest `most` keys of each row, ascending; on a CPU the keys are sorted where they are."""
    if keys.device.type == "cpu":
        array = keys.numpy()
        array.sort(axis=-1)
        return torch.from_numpy(np.ascontiguousarray(array[:, :most]))
    return torch.topk(keys, most, dim=-1, largest=False, sorted=True).values
