"""Leaving out early what a whole tile of rays misses, so that cost grows slower than the number of Gaussians.

A tile is 16 rays that follow each other: 4 x 4 pixels of a picture, or one pixel of each of 4 x 4 cells of a photo. Its
bearings (x / z and y / z of a frame that looks from the camera at the box's middle) lie in a rectangle, and so do those
of all of a Gaussian that counts; where the rectangles are apart no ray of the tile meets the Gaussian. Only the rest is
tried ray by ray. Tiles that may meet about as many Gaussians are worked on together, so that few are padded to the
fullest's count.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize, one_hot, pad

from carstudio.rendering.gaussians.cloud import Splats
from carstudio.rendering.gaussians.cpu_kernels import places_of, quotient
from carstudio.rendering.gaussians.reference import reach_limit
from carstudio.rendering.gaussians.symmetric import Symmetric3, planes3

TILE_PX = 4
TILE = TILE_PX**2  # rays that are tried together
LARGEST_TILE = 0.25  # of all bearings; rays whose tiles are larger are scattered, and tried one by one
CLASSES = 4  # of tiles by how many Gaussians they may meet, each of as many tiles
_SAME_EYE = 1e-4  # canonical units
_NEAREST_EYE = 2.0  # canonical units from the middle: nearer than that the box may be on all sides
_MARGIN = 1e-3  # share of a Gaussian's squared reach, for rounding


@dataclass(frozen=True)
class TileClass:
    """Some tiles and the Gaussians that each may meet."""

    tiles: Int[Tensor, " tile"]
    """Numbers among all tiles of the batch."""
    splats: Int[Tensor, "tile candidate"]
    """Numbers in the tile's batch entry; the number of Gaussians stands for none."""


def tile_classes(
    splats: Splats, origins: Float[Tensor, "batch ray 3"], directions: Float[Tensor, "batch ray 3"]
) -> list[TileClass] | None:
    """Tiles that may meet a Gaussian, by how many; None where all rays are to be tried with all Gaussians.

    That is: where they do not come in tiles, leave from different places (canonical), or where a tile is hardly smaller
    than all of them.
    """
    if origins.shape[1] == 0 or origins.shape[1] % TILE:
        return None
    with torch.no_grad():
        eye = origins[:, 0]
        if bool(((origins - eye[:, None]).abs() > _SAME_EYE).any()) or bool((eye.norm(dim=-1) < _NEAREST_EYE).any()):
            return None
        axes = _looking_at_the_middle(eye)
        seen = directions @ axes.mT
        if bool((seen[..., 2] <= 0).any()):
            return None
        bearings = (seen[..., :2] / seen[..., 2:]).movedim(-1, 0).unflatten(2, (-1, TILE))
        tiles = (bearings.amin(dim=-1), bearings.amax(dim=-1))
        extent = tiles[1].amax(dim=-1) - tiles[0].amin(dim=-1)
        share = (tiles[1] - tiles[0]).prod(dim=0).mean(dim=-1) / extent.prod(dim=0).clamp(min=1e-12)
        if float(share.mean()) > LARGEST_TILE:
            return None
        return _classes(_is_met(tiles, _rectangles(splats, eye, axes)))


Rectangles = tuple[Float[Tensor, "2 batch _"], Float[Tensor, "2 batch _"]]
"""Least and largest bearings on both axes."""


def _looking_at_the_middle(eye: Float[Tensor, "batch 3"]) -> Float[Tensor, "batch 3 3"]:
    """Rows: unit vectors across, across and towards the origin from an eye."""
    toward = -normalize(eye, dim=-1)
    across = normalize(torch.linalg.cross(one_hot(toward.abs().argmin(dim=-1), 3).to(toward), toward), dim=-1)
    return torch.stack([across, torch.linalg.cross(toward, across), toward], dim=1)


def _rectangles(splats: Splats, eye: Float[Tensor, "batch 3"], axes: Float[Tensor, "batch 3 3"]) -> Rectangles:
    """Of the bearings at which Gaussians count; endless where one reaches to the eye's plane, none where too faint.

    With mean (x, z) and reach S (a covariance times the squared distance that counts) a bearing s touches the ellipsoid
    where (x - s z)^2 = S_xx - 2 s S_xz + s^2 S_zz.
    """
    limit = reach_limit(splats.opacity)
    reach = (_turned(splats.precision.inverse(), axes) * (limit.clamp(min=0) * (1 + _MARGIN))[:, None]).unbind(1)
    mean = planes3((splats.mean - eye[:, None]) @ axes.mT)
    zz = mean[2] * mean[2] - reach[0]
    ends = []
    for x, s_xx, s_xz in zip(mean[:2], reach[1:3], reach[3:], strict=True):
        xz, xx = x * mean[2] - s_xz, x * x - s_xx
        root = (xz * xz - zz * xx).clamp(min=0).sqrt()
        ends.append(((xz - root) / zz, (xz + root) / zz))
    low, high = (torch.stack(end) for end in zip(*ends, strict=True))
    is_near, is_faint = zz <= 0, limit <= 0
    return low.masked_fill(is_near, -torch.inf).masked_fill(is_faint, torch.inf), high.masked_fill(is_near, torch.inf)


def _turned(matrices: Symmetric3, axes: Float[Tensor, "batch 3 3"]) -> Float[Tensor, "batch 5 splat"]:
    """zz, xx, yy, xz and yz of A M A^T for the rows A of each entry's axes: one product, as a^T M b is linear in M."""
    first, second = axes[:, [2, 0, 1, 0, 1]], axes[:, [2, 0, 1, 2, 2]]
    both = first[..., :, None] * second[..., None, :]
    own = Symmetric3.of_matrix(both + both.mT)
    halves = torch.stack([own.xx / 2, own.xy, own.xz, own.yy / 2, own.yz, own.zz / 2], dim=-1)
    m = matrices
    return halves @ torch.stack([m.xx, m.xy, m.xz, m.yy, m.yz, m.zz], dim=1)


def _is_met(tiles: Rectangles, splats: Rectangles) -> Bool[Tensor, "batch tile splat"]:
    """Which Gaussians each tile may meet: not apart on either axis. What is no number is met: it shall be seen.

    NumPy compares in a fraction of the time that torch takes on a CPU.
    """
    on_cpu = tiles[0].device.type == "cpu"
    first, last, low, high = (part.numpy() if on_cpu else part for part in (*tiles, *splats))
    is_apart = low[0, :, None] > last[0, :, :, None]
    is_apart |= high[0, :, None] < first[0, :, :, None]
    is_apart |= low[1, :, None] > last[1, :, :, None]
    is_apart |= high[1, :, None] < first[1, :, :, None]
    return torch.as_tensor(~is_apart)


def _classes(is_met: Bool[Tensor, "batch tile splat"]) -> list[TileClass]:
    num_splats = is_met.shape[-1]
    flat = places_of(is_met)
    tile = quotient(flat, num_splats)
    counts = torch.bincount(tile, minlength=is_met.shape[0] * is_met.shape[1])
    start = counts.cumsum(0) - counts
    splats = pad(flat.sub_(tile, alpha=num_splats), (0, 1), value=num_splats)
    by_count = counts.argsort()[int((counts == 0).sum()) :]
    found = []
    for chosen in by_count.tensor_split(min(CLASSES, max(1, len(by_count) // TILE))) if len(by_count) else ():
        own = counts[chosen]
        rank = torch.arange(int(own[-1]), device=own.device)
        place = (start[chosen][:, None] + rank).masked_fill_(rank >= own[:, None], len(splats) - 1)
        found.append(TileClass(chosen, splats[place]))
    return found
