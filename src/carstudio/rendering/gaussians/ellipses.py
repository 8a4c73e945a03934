"""Gaussians as a pinhole camera sees them: ellipses in the image, in NumPy, since arrays of 512 are all overhead.

In the camera frame a Gaussian has mean z d with d = (x, y, 1), covariance S, and S has the cofactors C. A ray along
d + a, a = (dx, dy, 0), passes it at the squared distance z^2 (a x d)^T S (a x d) / (d^T C d), but for the denominator,
exactly: that would be taken along d + a. So contours are ellipses, right where Gaussians are small beside z.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from carstudio.rendering.gaussians.cloud import GaussianCloud, light_terms
from carstudio.rendering.gaussians.reference import FAINTEST, MAX_ALPHA

_PIXEL_VARIANCE = 1 / 12  # px^2, of a pixel's square along each axis; what `rays.pixel_rays` makes of it
_NEAREST_M = 1e-3  # no Gaussian of a box in front of the camera is so near


@dataclass(frozen=True)
class BakedCloud:
    """Gaussians of one car (canonical frame) with covariances multiplied out, ready to be drawn again and again."""

    mean: Float[np.ndarray, "splat 3"]
    covariance: Float[np.ndarray, "splat 3 3"]
    opacity: Float[np.ndarray, " splat"]
    rgb: Float[np.ndarray, "splat 3"]
    tint: Float[np.ndarray, "splat 3 3"] | None
    light: Float[np.ndarray, "9 3"] | None

    def colour_from(self, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "splat 3"]:
        """As `GaussianCloud.colour_from`."""
        colour = self.rgb
        if self.tint is not None:
            sight = self.mean - eye
            sight /= np.sqrt((sight * sight).sum(axis=-1, keepdims=True))
            colour = np.clip(colour + (self.tint @ sight[..., None])[..., 0], 0, 1)
        if self.light is not None:
            x, y, z = (eye / np.sqrt((eye * eye).sum()))[:, None]
            colour = np.minimum(colour * np.exp(np.stack(light_terms(x, y, z), axis=-1) @ self.light), 1)
        return colour


@dataclass(frozen=True)
class Ellipses:
    """Gaussians in an image, those alone that can be seen: a column of `table` and a colour each.

    Rows: u and v of the middle (px); the form's uu, uv and vv (px^-2); the squared distance at which the faintest alpha
    that counts is reached; half width and half height (px) of the ellipse up to there; log of the opacity; depth (m) of
    the middle, and how the depth at which a ray's response peaks changes along u and v (m / px).
    """

    table: Float[np.ndarray, "12 splat"]
    rgb: Float[np.ndarray, "splat 3"]


def bake_cloud(cloud: GaussianCloud) -> BakedCloud:
    """The first car of a batch: on the CPU, in single precision, without gradients."""
    parts = cloud.mean, cloud.covariance().matrix(), cloud.opacity, cloud.rgb, cloud.tint, cloud.light
    arrays = [None if part is None else part[0].detach().float().cpu().numpy() for part in parts]
    return BakedCloud(*arrays)  # type: ignore[arg-type]


def ellipses_of(
    cloud: BakedCloud,
    intrinsics: tuple[float, float, float, float],
    *,
    center: Float[np.ndarray, "3"],
    size: Float[np.ndarray, "3"],
    rotation: Float[np.ndarray, "3 3"],
    widen: bool = True,
) -> Ellipses:
    """The cloud in a box (centre and size in metres, `camera_from_car`) in front of a camera (fx, fy, cx, cy in px).

    `widen` adds a pixel's footprint and thins the opacity as `cloud.widened_splats` does.
    """
    fx, fy, cx, cy = intrinsics
    linear = rotation * (size / 2)
    mean = cloud.mean @ linear.T + center
    depth = np.maximum(mean[:, 2], _NEAREST_M)
    x, y = mean[:, 0] / depth, mean[:, 1] / depth
    xx, xy, xz, yy, yz, zz = _upper(linear @ cloud.covariance @ linear.T)
    _, thin = _cofactors_along(x, y, xx, xy, xz, yy, yz, zz)
    if widen:
        footprint = depth * depth * np.float32(_PIXEL_VARIANCE / (fx * fy))
        xx, yy, zz = xx + footprint, yy + footprint, zz + footprint
    (tilt_x, tilt_y), area = _cofactors_along(x, y, xx, xy, xz, yy, yz, zz)
    opacity = np.minimum(cloud.opacity * np.sqrt(np.minimum(thin / area, 1)), MAX_ALPHA)
    limit = 2 * np.log(np.maximum(opacity / FAINTEST, 1e-12))
    scale = depth * depth / area
    uu = scale * (yy - 2 * y * yz + y * y * zz) / (fx * fx)
    vv = scale * (xx - 2 * x * xz + x * x * zz) / (fy * fy)
    uv = scale * (x * yz + y * xz - xy - x * y * zz) / (fx * fy)
    is_seen = (limit > 0) & (mean[:, 2] > _NEAREST_M)
    spread = np.sqrt(np.maximum(limit, 0) / np.maximum(uu * vv - uv * uv, 1e-20))
    slant = -depth / area
    table = np.stack(
        [
            *(x * fx + cx, y * fy + cy),
            *(uu, uv, vv, limit),
            *(spread * np.sqrt(vv), spread * np.sqrt(uu)),
            *(np.log(np.maximum(opacity, 1e-12)), depth, slant * tilt_x / fx, slant * tilt_y / fy),
        ]
    )
    rgb = cloud.colour_from(-(rotation.T @ center) / (size / 2))
    return Ellipses(table[:, is_seen].astype(np.float32), rgb[is_seen].astype(np.float32))


def _upper(matrix: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(matrix[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))


def _cofactors_along(
    x: np.ndarray,
    y: np.ndarray,
    xx: np.ndarray,
    xy: np.ndarray,
    xz: np.ndarray,
    yy: np.ndarray,
    yz: np.ndarray,
    zz: np.ndarray,
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """First two numbers of C d, and d^T C d, for d = (x, y, 1) and the cofactors C of a covariance."""
    first, second, third = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    along_x = first * x + second * y + third
    along_y = second * x + (xx * zz - xz * xz) * y + xy * xz - xx * yz
    along_z = third * x + (xy * xz - xx * yz) * y + xx * yy - xy * xy
    return (along_x, along_y), along_x * x + along_y * y + along_z
