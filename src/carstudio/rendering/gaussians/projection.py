"""Gaussians as the rays of a pinhole camera meet them, in pixels; in NumPy: arrays of a thousand are all overhead.

In the camera frame a Gaussian has mean z d with d = (x, y, 1), covariance S, and S has the cofactors C. A ray along
d + a, a = (dx, dy, 0), passes it at the squared distance z^2 (a x d)^T S (a x d) / ((d + a)^T C (d + a)) and comes
nearest to it at the depth z (d + a)^T C d / ((d + a)^T C (d + a)): exactly so, and in polynomials of a alone.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.rendering.gaussians.cloud import GaussianCloud, light_terms
from carstudio.rendering.gaussians.reference import FAINTEST

_PIXEL_VARIANCE = 1 / 12  # px^2, of a pixel's square along each axis; what `rays.pixel_rays` makes of it
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_NEAREST_M = 1e-3  # no Gaussian of a box in front of the camera is so near


@dataclass(frozen=True)
class BakedCloud:
    """Gaussians of one car (canonical frame) with covariances multiplied out, ready to be drawn again and again."""

    mean: Float[np.ndarray, "splat 3"]
    covariance: Float[np.ndarray, "6 splat"]
    """Rows xx, xy, xz, yy, yz and zz."""
    opacity: Float[np.ndarray, " splat"]
    rgb: Float[np.ndarray, "splat 3"]
    tint: Float[np.ndarray, "3 3 splat"] | None
    """Channel, then axis of the line of sight."""
    light: Float[np.ndarray, "9 3"] | None

    def colour_from(self, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "splat 3"]:
        """As `GaussianCloud.colour_from`."""
        colour = self.rgb
        if self.tint is not None:
            sight = (self.mean - eye).T
            sight /= np.sqrt((sight * sight).sum(axis=0))
            colour = np.minimum(np.maximum(colour + (self.tint * sight).sum(axis=1).T, 0), 1)
        if self.light is not None:
            x, y, z = (eye / np.sqrt((eye * eye).sum()))[:, None]
            colour = np.minimum(colour * np.exp(np.stack(light_terms(x, y, z), axis=-1) @ self.light), 1)
        return colour


def bake_cloud(cloud: GaussianCloud) -> BakedCloud:
    """The first car of a batch: on the CPU, in single precision, without gradients."""
    covariance = cloud.covariance()
    parts = (
        cloud.mean,
        torch.stack([covariance.xx, covariance.xy, covariance.xz, covariance.yy, covariance.yz, covariance.zz], dim=1),
        cloud.opacity,
        cloud.rgb,
        None if cloud.tint is None else cloud.tint.permute(0, 2, 3, 1),
        cloud.light,
    )
    arrays = [None if part is None else part[0].detach().float().cpu().contiguous().numpy() for part in parts]
    return BakedCloud(*arrays)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Projected:
    """With (du, dv) from a Gaussian's middle: D = 1 + 2 g du + du^T h du, squared distance (du^T q du) / D, depth
    z (1 + g du) / D. A value per Gaussian, px and metres.
    """

    u: Float[np.ndarray, " splat"]
    v: Float[np.ndarray, " splat"]
    depth: Float[np.ndarray, " splat"]
    """z of the middle, m."""
    spread_m: Float[np.ndarray, " splat"]
    """Standard deviation along z, m."""
    opacity: Float[np.ndarray, " splat"]
    """Thinned as the pixel's footprint widens the Gaussian."""
    uu: Float[np.ndarray, " splat"]
    uv: Float[np.ndarray, " splat"]
    vv: Float[np.ndarray, " splat"]
    """q."""
    g_u: Float[np.ndarray, " splat"]
    g_v: Float[np.ndarray, " splat"]
    h_uu: Float[np.ndarray, " splat"]
    h_uv: Float[np.ndarray, " splat"]
    h_vv: Float[np.ndarray, " splat"]
    rgb: Float[np.ndarray, "splat 3"]

    @property
    def limit(self) -> Float[np.ndarray, " splat"]:
        """Squared distance at which the faintest alpha that counts is reached; negative: it never is."""
        return np.asarray(2 * np.log(np.maximum(self.opacity / FAINTEST, 1e-12)))

    @property
    def is_seen(self) -> Bool[np.ndarray, " splat"]:
        """In front of the camera and not too faint anywhere."""
        return np.asarray((self.opacity > FAINTEST) & (self.depth > _NEAREST_M))


def project(cloud: BakedCloud, camera: Camera, box: Box3D, *, widen: bool = True) -> Projected:
    """The cloud in a box (a batch of one) before a camera, both on the CPU; computed in double precision.

    `widen` adds a pixel's footprint and thins the opacity as `cloud.widened_splats` does.
    """
    fx, fy, cx, cy = camera.intrinsics.tolist()
    center, size, rotation = (part[0].double().numpy() for part in (box.center, box.size, box.rotation))
    linear = rotation * (size / 2)
    mean = cloud.mean @ linear.T + center
    depth = np.maximum(mean[:, 2], _NEAREST_M)
    x, y = mean[:, 0] / depth, mean[:, 1] / depth
    xx, xy, xz, yy, yz, zz = _turning(linear) @ cloud.covariance
    _, thin = _cofactors_along(x, y, xx, xy, xz, yy, yz, zz)
    if widen:
        footprint = depth * depth * (_PIXEL_VARIANCE / (fx * fy))
        xx, yy, zz = xx + footprint, yy + footprint, zz + footprint
    (tilt_x, tilt_y), area = _cofactors_along(x, y, xx, xy, xz, yy, yz, zz)
    scale = depth * depth / area
    return Projected(
        u=x * fx + cx,
        v=y * fy + cy,
        depth=depth,
        spread_m=np.sqrt(zz),
        opacity=cloud.opacity * np.sqrt(np.minimum(thin / area, 1)),
        uu=scale * (yy - 2 * y * yz + y * y * zz) / (fx * fx),
        uv=scale * (x * yz + y * xz - xy - x * y * zz) / (fx * fy),
        vv=scale * (xx - 2 * x * xz + x * x * zz) / (fy * fy),
        g_u=tilt_x / (area * fx),
        g_v=tilt_y / (area * fy),
        h_uu=(yy * zz - yz * yz) / (area * (fx * fx)),
        h_uv=(xz * yz - xy * zz) / (area * (fx * fy)),
        h_vv=(xx * zz - xz * xz) / (area * (fy * fy)),
        rgb=cloud.colour_from(-(rotation.T @ center) / (size / 2)),
    )


def _turning(linear: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6 6"]:
    """What takes the upper triangle of a covariance S, row by row, to that of A S A^T."""
    columns = []
    for i, j in _UPPER:
        unit = np.zeros((3, 3))
        unit[i, j] = unit[j, i] = 1
        turned = linear @ unit @ linear.T
        columns.append([turned[row, column] for row, column in _UPPER])
    return np.array(columns).T


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
