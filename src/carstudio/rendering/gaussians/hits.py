"""Rays and Gaussians, the fast way: three matrix products, one sort of packed keys, and only the hits differentiated.

With the ten numbers of a Gaussian g = (P as 6, P mu as 3, mu^T P mu) the quantities of `reference` are products of g
with features of the ray's point x and direction d: c = a^T P a with (x x, -2 x, 1), b with (d x, -d), e with (d d).
The point x lies near the car, never at the camera: c - b^2 / e would cancel away there in float32.
"""

import math
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from carstudio.rendering.gaussians.cloud import Splats
from carstudio.rendering.gaussians.cpu_kernels import first_sorted, places_of_negative, quotient
from carstudio.rendering.gaussians.reference import FAINTEST, MAX_ALPHA, reach_limit
from carstudio.rendering.gaussians.symmetric import Planes, dot, planes3
from carstudio.rendering.gaussians.tiles import TILE, TileClass

_CHUNK = {"cpu": 2**17, "other": 2**26}  # ray-splat pairs at a time: on a CPU some arrays of them fit the L2 cache
_PAIRS = ((0, 1), (0, 2), (1, 2))
REACH = 4.0  # canonical units: farther from x than this along the ray no Gaussian of a box [-1, 1]^3 can peak


def ray_hits(
    splats: Splats,
    points: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    nearest: Float[Tensor, "batch ray"],
    *,
    most: int,
    classes: list[TileClass] | None = None,
) -> tuple[Float[Tensor, "batch ray hit"], Float[Tensor, "batch ray hit"], Int[Tensor, "batch ray hit"]]:
    """The first `most` Gaussians along each ray x + t d whose alpha is worth showing, from front to back.

    Gives alpha, t of the peak and the Gaussian's number; alpha and number are 0 where there are fewer. `directions` are
    unit vectors and `points` within two units of the origin. Peaks at t <= `nearest` (the camera) count as missed.
    With `classes` rays are tried with what their tile may meet, else with all Gaussians.
    Gradients flow through alpha and t, in closed form, to the splats and, where they are asked for, to points and
    directions.
    """
    features = torch.cat(ray_features(points, directions), dim=-1)
    coefficients = splat_coefficients(splats)
    alpha, t, index = _Hits.apply(coefficients, splats.opacity, features, nearest, most, classes)
    return alpha, t, index


def splat_coefficients(splats: Splats) -> Float[Tensor, "batch 10 splat"]:
    """The ten numbers of each Gaussian that c, b and e are linear in."""
    p, mean = splats.precision, planes3(splats.mean)
    p_mu = p.times(mean)
    return torch.stack([p.xx, p.yy, p.zz, p.xy, p.xz, p.yz, *p_mu, dot(p_mu, mean)], dim=-2)


def ray_features(
    points: Float[Tensor, "batch ray 3"], directions: Float[Tensor, "batch ray 3"]
) -> tuple[Float[Tensor, "batch ray 10"], Float[Tensor, "batch ray 9"], Float[Tensor, "batch ray 6"]]:
    """Factors of the coefficients in c (10), b (the first 9) and e (the first 6)."""
    x, d = planes3(points), planes3(directions)
    c, b, e = (torch.stack(factors, dim=-1) for factors in (_factors_of_c(x), _factors_of_b(x, d), _factors_of_e(d)))
    return c, b, e


def _factors_of_c(x: Planes) -> list[Tensor]:
    return [*_factors_of_e(x), *(-2 * axis for axis in x), torch.ones_like(x[0])]


def _factors_of_b(x: Planes, d: Planes) -> list[Tensor]:
    mixed = [d[i] * x[j] + d[j] * x[i] for i, j in _PAIRS]
    return [*(a * b for a, b in zip(d, x, strict=True)), *mixed, *(-axis for axis in d)]


def _factors_of_e(d: Planes) -> list[Tensor]:
    return [*(axis * axis for axis in d), *(2 * d[i] * d[j] for i, j in _PAIRS)]


def _rays_of(features: Float[Tensor, "batch ray 25"], chosen: Int[Tensor, " pair"]) -> tuple[Planes, Planes]:
    """Points and directions of chosen rays (counted through the batch): -2 x and -d are among the features."""
    table = features.flatten(0, 1)[:, [6, 7, 8, 16, 17, 18]].T.contiguous().index_select(1, chosen)
    x0, x1, x2, d0, d1, d2 = table.mul_(table.new_tensor([-0.5] * 3 + [-1.0] * 3)[:, None])
    return (x0, x1, x2), (d0, d1, d2)


class _Hits(torch.autograd.Function):
    """See `ray_hits`; rays are worked off in chunks, nothing of the size rays x splats outlives one."""

    @staticmethod
    def forward(
        ctx: Any,
        coefficients: Tensor,
        opacity: Tensor,
        features: Tensor,
        nearest: Tensor,
        most: int,
        classes: list[TileClass] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        most = min(most, opacity.shape[-1])
        limited = coefficients.clone()
        limited[:, 9] -= reach_limit(opacity)
        if classes is None:
            alpha, t, index = _nearest_hits(limited, features, nearest, most)
        else:
            alpha, t, index = _hits_by_tiles(limited, features, nearest, most, classes)
        ctx.save_for_backward(coefficients, opacity, features, alpha, t, index)
        ctx.mark_non_differentiable(index)
        return alpha, t, index

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, opacity, features, alpha, t, index = ctx.saved_tensors
        place = places_of_negative(-alpha)
        ray = quotient(place, alpha.shape[-1])
        alpha, t, splat, to_alpha, to_t = (
            values.flatten().index_select(0, place) for values in (alpha, t, index, *gradients[:2])
        )
        splat += quotient(ray, features.shape[1]).mul_(opacity.shape[1])
        to_log = to_alpha * alpha * (alpha < MAX_ALPHA)
        to_opacity = opacity.new_zeros(opacity.numel()).scatter_add_(0, splat, to_log).view_as(opacity)
        # distance2 = c - b^2 / e and t = -b / e. Along the ray c + 2 t b + t^2 e is c of the point x + t d, b + t e is
        # its b: so the slopes in a Gaussian's numbers are those of c and b at the peak.
        g, x, d = to_log.mul_(-0.5), *_rays_of(features, ray)
        peak = (x[0] + t * d[0], x[1] + t * d[1], x[2] + t * d[2])
        to_own = opacity.new_zeros(10, opacity.numel())
        for into, factor in zip(to_own, _factors_of_c(peak), strict=True):
            into.scatter_add_(0, splat, g * factor)
        s = None
        own = coefficients.transpose(0, 1).flatten(1)
        if bool(to_t.any()):
            s = to_t / sum(own[k].index_select(0, splat) * factor for k, factor in enumerate(_factors_of_e(d)))
            for into, factor in zip(to_own, _factors_of_b(peak, d), strict=False):
                into.scatter_add_(0, splat, -s * factor)
        to_features = None
        if ctx.needs_input_grad[2]:
            slopes = (g, 2 * t * g, t * t * g) if s is None else (g, 2 * t * g - s, t * (t * g - s))
            to_features = _to_features(features, slopes, own, ray, splat)
        to_coefficients = to_own.unflatten(1, opacity.shape).transpose(0, 1)
        return to_coefficients, to_opacity / opacity.clamp(min=FAINTEST), to_features, None, None, None


def _to_features(
    features: Tensor, slopes: tuple[Tensor, Tensor, Tensor], own: Tensor, ray: Tensor, splat: Tensor
) -> Tensor:
    """Slopes in the rays' features, of hits' slopes in c, b and e and the Gaussians' numbers."""
    found = features.new_zeros(features.shape[-1], features[..., 0].numel())
    for slope, first, width in zip(slopes, (0, 10, 19), (10, 9, 6), strict=True):
        for k in range(width):
            found[first + k].scatter_add_(0, ray, slope * own[k].index_select(0, splat))
    return found.T.reshape(features.shape)


def _chunks(features: Tensor, num_splats: int) -> list[tuple[slice, slice]]:
    """Slices (batch entries, rays) small enough to work on at once."""
    batch, num_rays = features.shape[:2]
    pairs = _CHUNK["cpu" if features.device.type == "cpu" else "other"]
    rays = max(1, min(num_rays, pairs // num_splats))
    entries = max(1, pairs // (num_splats * num_rays)) if rays == num_rays else 1
    return [
        (slice(entry, entry + entries), slice(ray, ray + rays))
        for entry in range(0, batch, entries)
        for ray in range(0, num_rays, rays)
    ]


def _hits_by_tiles(
    limited: Tensor, features: Tensor, nearest: Tensor, most: int, classes: list[TileClass]
) -> tuple[Tensor, Tensor, Tensor]:
    """`_nearest_hits` of all rays, each tile's with what the tile may meet."""
    batch, num_rays, num_splats = len(features), features.shape[1], limited.shape[-1]
    table = pad(limited.mT, (0, 0, 0, 1)).flatten(0, 1)  # with a row of zeros for none, which is never near
    by_tile, nearest = features.unflatten(1, (-1, TILE)).flatten(0, 1), nearest.reshape(-1, TILE)
    found = (
        features.new_zeros(len(by_tile), TILE, most),
        features.new_full((len(by_tile), TILE, most), REACH),
        torch.zeros(len(by_tile), TILE, most, dtype=torch.long, device=features.device),
    )
    for one in classes:
        row = one.splats + quotient(one.tiles, num_rays // TILE)[:, None] * (num_splats + 1)
        own = table.index_select(0, row.flatten()).unflatten(0, row.shape).mT
        hits = _nearest_hits(own, by_tile[one.tiles], nearest[one.tiles], most, one.splats)
        for into, part in zip(found, hits, strict=True):
            into.index_copy_(0, one.tiles, part)
    alpha, t, index = (values.view(batch, num_rays, most) for values in found)
    return alpha, t, index


def _nearest_hits(
    limited: Float[Tensor, "batch 10 splat"],
    features: Float[Tensor, "batch ray 25"],
    nearest: Float[Tensor, "batch ray"],
    most: int,
    numbers: Int[Tensor, "batch splat"] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """alpha, t and number of the first hits; in `limited` the reach is taken off c. Without `numbers` they count up."""
    num_splats = limited.shape[-1]
    flat, over, t = _near_pairs(limited, features)
    ray = quotient(flat, num_splats)
    if bool((nearest > -REACH).any()):  # the camera is so near that Gaussians may lie behind it
        is_before = ~(t <= nearest.flatten().index_select(0, ray))  # also of what is no number
        if not bool(is_before.all()):
            flat, ray, over, t = (values[is_before] for values in (flat, ray, over, t))
    counts = torch.bincount(ray, minlength=nearest.numel())
    place = _first_of_each(t, ray, counts, most).flatten()
    if numbers is None:
        index = torch.add(flat, ray, alpha=-num_splats)
    else:
        entry = quotient(ray, features.shape[1])
        index = numbers.flatten().index_select(0, flat.sub_(ray.sub_(entry), alpha=num_splats))
    # opacity exp(-distance2 / 2) is FAINTEST exp(-over / 2), since over = distance2 - 2 log(opacity / FAINTEST)
    alpha = over.mul_(-0.5).exp_().mul_(FAINTEST).clamp_(max=MAX_ALPHA)
    alpha, t, index = (
        pad(values, (0, 1), value=none).index_select(0, place).view(*nearest.shape, most)
        for values, none in ((alpha, 0), (t, REACH), (index, 0))
    )
    return alpha, t, index


def _near_pairs(limited: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays and Gaussians that come near enough to each other: flat places in (entry, ray, splat), distance2 - limit, t.

    c - limit - b^2 / e < 0 is asked as (c - limit) e - b^2 < 0, so that what is too far, nearly all, is neither divided
    nor sorted. What is no number counts as near: whoever looks at it shall see it.
    """
    num_rays, num_splats = features.shape[1], limited.shape[-1]
    chunks = _chunks(features, num_splats)
    room = features.new_empty(3, features[chunks[0]].shape[:2].numel() * num_splats)
    places, found = [], []
    for entries, rays in chunks:
        part, own = features[entries, rays], limited[entries]
        shape = (*part.shape[:2], num_splats)
        over, b, e = (values[: math.prod(shape)].view(shape) for values in room)
        torch.matmul(part[..., 10:19], own[:, :9], out=b)
        torch.matmul(part[..., 19:], own[:, :6], out=e)
        torch.matmul(part[..., :10], own, out=over)
        over.mul_(e).addcmul_(b, b, value=-1)
        flat = places_of_negative(over)
        found.append(room.index_select(1, flat))
        places.append(flat.add_((entries.start * num_rays + rays.start) * num_splats))
    over, b, e = torch.cat(found, dim=1)
    return torch.cat(places), over.div_(e), b.div_(e).neg_()


def _first_of_each(
    t: Float[Tensor, " pair"], ray: Int[Tensor, " pair"], counts: Int[Tensor, " ray"], most: int
) -> Int[Tensor, "ray most"]:
    """Places of each ray's `most` smallest t, ascending; where it has fewer, the number of pairs.

    Keys of 64 bits hold t, its bits turned so that they grow with it, above and the place below.
    """
    bits = t.float().view(torch.int32)
    places = torch.arange(len(t), device=t.device)
    keys = (bits ^ ((bits >> 31) & (2**31 - 1))).long().mul_(2**32).add_(places)
    width = max(most, int(counts.max()))
    own = torch.arange(len(counts), device=t.device).mul_(width).sub_(counts.cumsum(0) - counts)
    table = keys.new_full((len(counts) * width,), (2**31 - 1) * 2**32 + len(t))
    table = table.scatter_(0, places.add_(own.index_select(0, ray)), keys).view(-1, width)
    return first_sorted(table, most).bitwise_and_(2**32 - 1)
