"""Leaving out early what a whole tile of rays misses, so that cost grows slower than the number of Gaussians.

Rays that follow each other (the 16 of a 4 x 4 tile) are met as one thick ray first: with every Gaussian's reach grown
by the tile's radius, what the middle ray misses all of them miss. Only the rest is tried ray by ray. Tiles that may
meet about as many Gaussians are worked on together, so that few are padded to the fullest's count.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from carstudio.rendering.gaussians.cloud import Splats
from carstudio.rendering.gaussians.hits import ray_features, reach_limit, splat_coefficients

TILE_PX = 4
TILE = TILE_PX**2  # rays that are tried together
COHERENT = 0.7  # canonical radius up to which a group of rays is a tile; scattered rays are tried one by one
CLASSES = 4  # of tiles by how many Gaussians they may meet, each of as many tiles
_INSIDE = 1.75  # canonical units from the middle of a ray to where it leaves the box, at most sqrt(3)
_SHARE = 0.5  # of the outer ellipsoid: (1 + a) Sigma + (1 + 1 / a) r^2 / limit holds ellipsoid plus ball for any a > 0


@dataclass(frozen=True)
class Encounter:
    """Groups of rays and the Gaussians each of them may meet, as products take them (`hits`), with their colours."""

    coefficients: Float[Tensor, "group 10 splat"]
    opacity: Float[Tensor, "group splat"]
    rgb: Float[Tensor, "group splat 3"]
    features: Float[Tensor, "group ray 25"]
    nearest: Float[Tensor, "group ray"]
    groups: Int[Tensor, " group"] | None = None
    """Numbers of the groups among all tiles; None: these are all groups, the batch's entries."""


def encounter(
    splats: Splats,
    rgb: Float[Tensor, "batch splat 3"],
    points: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    nearest: Float[Tensor, "batch ray"],
) -> list[Encounter]:
    """By tiles where the rays come in tiles that lie together; else every ray of a batch entry with every Gaussian.

    Tiles that can meet none are in no encounter.
    """
    coefficients = splat_coefficients(splats)
    features = torch.cat(ray_features(points, directions), dim=-1)
    whole = [Encounter(coefficients, splats.opacity, rgb, features, nearest)]
    if points.shape[1] % TILE:
        return whole
    with torch.no_grad():
        tiles = (points.unflatten(1, (-1, TILE)).flatten(0, 1), directions.unflatten(1, (-1, TILE)).flatten(0, 1))
        middle, toward, radius = tile_radius(*tiles)
        if float(radius) > COHERENT:
            return whole
        is_met = _is_met(splats, middle, toward, radius, len(points))
        counts = is_met.sum(dim=-1)
        by_count = counts.argsort()[int((counts == 0).sum()) :]
        if len(by_count) == 0:
            return whole
        classes = by_count.tensor_split(min(CLASSES, max(1, len(by_count) // TILE)))
    table = torch.cat([coefficients.mT, splats.opacity[..., None], rgb], dim=-1).flatten(0, 1)
    features = features.unflatten(1, (-1, TILE)).flatten(0, 1)
    nearest = nearest.unflatten(1, (-1, TILE)).flatten(0, 1)
    found = []
    for chosen in classes:
        met, candidates = is_met[chosen].to(torch.uint8).topk(int(counts[chosen[-1]]), dim=-1)
        entry = chosen // (points.shape[1] // TILE)
        flat = (candidates + entry[:, None] * rgb.shape[1]).flatten()
        taken = table.index_select(0, flat).unflatten(0, candidates.shape)
        found.append(
            Encounter(
                taken[..., :10].mT.contiguous(),
                taken[..., 10] * met,
                taken[..., 11:],
                features[chosen],
                nearest[chosen],
                chosen,
            )
        )
    return found


def tile_radius(
    points: Float[Tensor, "tile ray 3"], directions: Float[Tensor, "tile ray 3"]
) -> tuple[Float[Tensor, "tile 1 3"], Float[Tensor, "tile 1 3"], Float[Tensor, ""]]:
    """Middle point and direction of each tile, and how far its rays stray from that middle ray inside the box."""
    point = points.mean(dim=1, keepdim=True)
    direction = torch.nn.functional.normalize(directions.mean(dim=1, keepdim=True), dim=-1)
    stray = (points - point).norm(dim=-1) + _INSIDE * (directions - direction).norm(dim=-1)
    return point, direction, stray.max()


def _is_met(splats: Splats, middle: Tensor, toward: Tensor, radius: Tensor, batch: int) -> Bool[Tensor, "tile splat"]:
    """Which Gaussians each tile may meet."""
    limit = reach_limit(splats.opacity).clamp(min=1e-3)
    ball = (1 + 1 / _SHARE) * radius**2 / limit
    outer = (splats.precision.inverse() * (1 + _SHARE)).plus_diagonal(ball, ball, ball).inverse()
    coefficients = splat_coefficients(Splats(splats.mean, outer, splats.opacity))
    features = ray_features(*(rays.view(batch, -1, 3) for rays in (middle, toward)))
    c, b, e = (part @ coefficients[:, : part.shape[-1]] for part in features)
    return (c - b * b / e < reach_limit(splats.opacity)[:, None]).flatten(0, 1)
