"""Axes and places of exported cars: glTF's +Y up, +Z front, +X to the car's left, metres, ground at Y = 0.

Ours are x front, y down, z left, about the box's centre.
"""

import torch
from jaxtyping import Float
from torch import Tensor

GLTF_FROM_CAR = ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0))  # a rotation, its own inverse


def gltf_from_canonical(
    size: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """(A, b) with p_gltf = A p_canonical + b for a car of `size` (length, height, width, m)."""
    turn = size.new_tensor(GLTF_FROM_CAR)
    return turn @ torch.diag(size / 2), size.new_tensor([0.0, float(size[1]) / 2, 0.0])
