"""Rays and Gaussians, the fast way: three matrix products, one sort of packed keys, and only the hits differentiated.

With the ten numbers of a Gaussian g = (P as 6, P mu as 3, mu^T P mu) the quantities of `reference` are products of g
with features of the ray's point x and direction d: c = a^T P a with (x x, -2 x, 1), b with (d x, -d), e with (d d).
The point x lies near the car, never at the camera: c - b^2 / e would cancel away there in float32.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.rendering.gaussians.cloud import Splats
from carstudio.rendering.gaussians.reference import FAINTEST, MAX_ALPHA
from carstudio.rendering.gaussians.symmetric import dot, planes3

_CHUNK = {"cpu": 2**17, "other": 2**26}  # ray-splat pairs at a time: on a CPU some arrays of them fit the L2 cache
REACH = 4.0  # canonical units: farther from x than this along the ray no Gaussian of a box [-1, 1]^3 can peak


def ray_hits(
    splats: Splats,
    points: Float[Tensor, "batch ray 3"],
    directions: Float[Tensor, "batch ray 3"],
    nearest: Float[Tensor, "batch ray"],
    *,
    most: int,
) -> tuple[Float[Tensor, "batch ray hit"], Float[Tensor, "batch ray hit"], Int[Tensor, "batch ray hit"]]:
    """The first `most` Gaussians along each ray x + t d whose alpha is worth showing, from front to back.

    Gives alpha (0 where there are fewer), t of the peak and the Gaussian's number. `directions` are unit vectors and
    `points` within two units of the origin. Peaks at t <= `nearest` (the camera) count as missed. Gradients flow
    through alpha and t, in closed form, to the splats and, where they are asked for, to points and directions.
    """
    features = torch.cat(ray_features(points, directions), dim=-1)
    return hits_of_features(splat_coefficients(splats), splats.opacity, features, nearest, most=most)


def hits_of_features(
    coefficients: Float[Tensor, "batch 10 splat"],
    opacity: Float[Tensor, "batch splat"],
    features: Float[Tensor, "batch ray 25"],
    nearest: Float[Tensor, "batch ray"],
    *,
    most: int,
) -> tuple[Float[Tensor, "batch ray hit"], Float[Tensor, "batch ray hit"], Int[Tensor, "batch ray hit"]]:
    """`ray_hits` of what `splat_coefficients` and `ray_features` (joined) give; opacity 0 is never hit."""
    alpha, t, index = _Hits.apply(coefficients, opacity, features, nearest, most)
    return alpha, t, index


def reach_limit(opacity: Float[Tensor, "batch splat"]) -> Float[Tensor, "batch splat"]:
    """Squared distance at which a Gaussian's alpha is the faintest that counts; negative: it never does."""
    return 2 * torch.log((opacity / FAINTEST).clamp(min=1e-12))


def splat_coefficients(splats: Splats) -> Float[Tensor, "batch 10 splat"]:
    """The ten numbers of each Gaussian that c, b and e are linear in."""
    p, mean = splats.precision, planes3(splats.mean)
    p_mu = p.times(mean)
    return torch.stack([p.xx, p.yy, p.zz, p.xy, p.xz, p.yz, *p_mu, dot(p_mu, mean)], dim=-2)


def ray_features(
    points: Float[Tensor, "batch ray 3"], directions: Float[Tensor, "batch ray 3"]
) -> tuple[Float[Tensor, "batch ray 10"], Float[Tensor, "batch ray 9"], Float[Tensor, "batch ray 6"]]:
    """Factors of the coefficients in c (10), b (the first 9) and e (the first 6)."""
    x, d = points, directions
    x0, x1, x2 = x.unbind(-1)
    d0, d1, d2 = d.unbind(-1)
    squares = torch.stack([x0 * x1, x0 * x2, x1 * x2], dim=-1)
    c = torch.cat([x * x, 2 * squares, -2 * x, torch.ones_like(x[..., :1])], dim=-1)
    mixed = torch.stack([d0 * x1 + d1 * x0, d0 * x2 + d2 * x0, d1 * x2 + d2 * x1], dim=-1)
    e = torch.cat([d * d, 2 * torch.stack([d0 * d1, d0 * d2, d1 * d2], dim=-1)], dim=-1)
    return c, torch.cat([d * x, mixed, -d], dim=-1), e


class _Hits(torch.autograd.Function):
    """See `ray_hits`; rays are worked off in chunks, nothing of the size rays x splats outlives one."""

    @staticmethod
    def forward(
        ctx: Any, coefficients: Tensor, opacity: Tensor, features: Tensor, nearest: Tensor, most: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        batch, num_rays, num_splats = features.shape[0], features.shape[1], opacity.shape[-1]
        most = min(most, num_splats)
        alpha, t = (features.new_empty(batch, num_rays, most) for _ in range(2))
        index = torch.empty(batch, num_rays, most, dtype=torch.int64, device=features.device)
        limit = reach_limit(opacity)
        for entries, rays in _chunks(features, num_splats):
            keys, over, at = _keys(
                features[entries, rays], coefficients[entries], limit[entries], nearest[entries, rays]
            )
            keys = _first(keys, most)
            rows = (keys & (2 ** _bits(num_splats) - 1)).long()
            hit = keys < _missed(num_splats)
            # opacity exp(-distance2 / 2) is FAINTEST exp(-over / 2), since over = distance2 - 2 log(opacity / FAINTEST)
            faded = torch.gather(over, -1, rows).clamp_(max=0).mul_(-0.5).exp_().mul_(hit)
            alpha[entries, rays] = faded.mul_(FAINTEST).clamp_(max=MAX_ALPHA)
            t[entries, rays] = torch.gather(at, -1, rows).div_(_scale(num_splats)).masked_fill_(~hit, REACH)
            index[entries, rays] = rows
        ctx.save_for_backward(coefficients, opacity, features, alpha, t, index)
        ctx.mark_non_differentiable(index)
        return alpha, t, index

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, opacity, features, alpha, t, index = ctx.saved_tensors
        grad_alpha, grad_t = gradients[0], gradients[1]
        free = (alpha < MAX_ALPHA) & (alpha > 0)
        to_log = grad_alpha * free * alpha
        grad_opacity = torch.zeros_like(opacity)
        grad_opacity.scatter_add_(-1, index.flatten(1), to_log.flatten(1)).div_(opacity.clamp(min=FAINTEST))
        to_distance2 = to_log * -0.5
        grad_coefficients = torch.zeros_like(coefficients)
        grad_features = torch.zeros_like(features) if ctx.needs_input_grad[2] else None
        for entries, rays in _chunks(features, coefficients.shape[-1]):
            part, rows, at = features[entries, rays], index[entries, rays], t[entries, rays]
            g = to_distance2[entries, rays]
            # distance2 = c - b^2 / e and t = -b / e: their slopes in c, b and e are (1, 2 t, t^2) and (0, -1/e, -t/e).
            to_t = torch.where(alpha[entries, rays] > 0, grad_t[entries, rays], 0.0)
            inverse_e = _inverse_e(part, coefficients[entries], rows) if bool(to_t.any()) else None
            to_b, to_e = 2 * at * g, at * at * g
            if inverse_e is not None:
                to_b, to_e = to_b - to_t * inverse_e, to_e - to_t * at * inverse_e
            dense = torch.zeros(*rows.shape[:2], coefficients.shape[-1], dtype=part.dtype, device=part.device)
            into = grad_coefficients[entries]
            for slope, first, width in ((g, 0, 10), (to_b, 10, 9), (to_e, 19, 6)):
                dense.scatter_(-1, rows, slope)  # the same places each time: no need to clear them
                into[:, :width] += part[..., first : first + width].mT @ dense
                if grad_features is not None:
                    own = coefficients[entries, :width].mT
                    grad_features[entries, rays, first : first + width] = dense @ own
        return grad_coefficients, grad_opacity, grad_features, None, None


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


def _keys(features: Tensor, coefficients: Tensor, limit: Tensor, nearest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sortable keys (t above, number below; `_missed`: no hit), distance2 - limit and scaled t of peaks.

    No comparisons: they cost more than arithmetic. What is farther than its limit is pushed out of the range of t.
    """
    num_splats = coefficients.shape[-1]
    scale = _scale(num_splats)
    coefficients = coefficients.clone()
    coefficients[:, 9] -= limit
    over = features[..., :10] @ coefficients
    b = (features[..., 10:19] * -scale) @ coefficients[:, :9]
    t = b.div(features[..., 19:] @ coefficients[:, :6])
    over.addcmul_(b, t, value=-1 / scale**2)
    last = 2 ** (29 - _bits(num_splats))
    place = torch.add(t, over.clamp(min=0), alpha=1e12)
    if bool((nearest > -REACH).any()):  # the camera is so near that Gaussians may lie behind it
        place = torch.where(t <= nearest[..., None] * scale, float(last), place)
    numbers = torch.arange(num_splats, dtype=torch.int32, device=t.device)
    keys = torch.add(numbers, place.clamp_(-last, last - 1).to(torch.int32), alpha=2 ** _bits(num_splats))
    return keys, over, t


def _bits(num_splats: int) -> int:
    """Bits that a Gaussian's number takes in a key."""
    return max(1, (num_splats - 1).bit_length())


def _scale(num_splats: int) -> float:
    """Steps of t per canonical unit: -reach to reach takes the bits that the number leaves of 30."""
    return 2 ** (29 - _bits(num_splats)) / REACH


def _missed(num_splats: int) -> int:
    """The first key that is no hit: the last step of t."""
    return (2 ** (29 - _bits(num_splats)) - 1) << _bits(num_splats)


def _first(keys: Tensor, most: int) -> Tensor:
    """The smallest `most` keys of each row, ascending; on CPUs NumPy sorts 30 times as fast as torch."""
    if keys.device.type == "cpu":
        array = keys.numpy()
        array.sort(axis=-1)
        return torch.from_numpy(np.ascontiguousarray(array[..., :most]))
    return torch.topk(keys, most, dim=-1, largest=False, sorted=True).values


def _inverse_e(features: Tensor, coefficients: Tensor, rows: Tensor) -> Tensor:
    """1 / e at the hits."""
    return torch.gather(features[..., 19:] @ coefficients[:, :6], -1, rows).reciprocal()
