"""Real spherical harmonics up to degree 3 as 3-D Gaussian viewers compute them (Kerbl et al., 2023), and fits of them.

A viewer shows max(0, 1/2 + sum_k c_k Y_k(d)), d the unit direction from the camera to the Gaussian. The Y_k are
orthonormal on the sphere; some have the sign of the Condon-Shortley phase.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.export.mesh import directions

NUM_TERMS = 16  # 1 + 3 + 5 + 7
SH_CONSTANT = 1 / (2 * math.sqrt(math.pi))  # Y_0


def harmonics(ways: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Y_0 to Y_15 of unit vectors, degree by degree."""
    x, y, z = ways.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    one, two = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    flat, edge, middle = math.sqrt(35 / (32 * math.pi)), math.sqrt(21 / (32 * math.pi)), math.sqrt(105 / (4 * math.pi))
    terms = [
        torch.full_like(x, SH_CONSTANT),
        *(-one * y, one * z, -one * x),
        *(two * x * y, -two * y * z, math.sqrt(5 / (16 * math.pi)) * (2 * zz - xx - yy)),
        *(-two * x * z, two / 2 * (xx - yy)),
        *(-flat * y * (3 * xx - yy), middle * x * y * z, -edge * y * (4 * zz - xx - yy)),
        math.sqrt(7 / (16 * math.pi)) * z * (2 * zz - 3 * xx - 3 * yy),
        *(-edge * x * (4 * zz - xx - yy), middle / 2 * z * (xx - yy), -flat * x * (xx - 3 * yy)),
    ]
    return torch.stack(terms, dim=-1)


def directions_around(count: int) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over the sphere (`directions` about y), double precision."""
    azimuth, elevation = torch.tensor(directions(count, lowest_deg=-90.0), dtype=torch.float64).deg2rad().unbind(-1)
    across = elevation.cos()
    return torch.stack([across * azimuth.cos(), elevation.sin(), across * azimuth.sin()], dim=-1)


def fitted(
    ways: Float[Tensor, "way splat 3"],
    weights: Float[Tensor, " way"],
    values: Float[Tensor, "way splat channel"],
) -> Float[Tensor, "splat channel 16"]:
    """Coefficients whose sum comes nearest to each splat's values by least squares, each way as its weight says."""
    terms = harmonics(ways)
    weighted = terms * weights[:, None, None]
    products = torch.einsum("wsi,wsj->sij", weighted, terms)
    return torch.linalg.solve(products, torch.einsum("wsi,wsc->sic", weighted, values)).mT
