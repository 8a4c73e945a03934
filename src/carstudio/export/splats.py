"""Splat PLY as 3-D Gaussian viewers read it (the format of Kerbl et al., 2023), in glTF's axes and metres.

Per Gaussian: x y z, normals (0), f_dc_0..2 (rgb as the constant spherical harmonic), opacity (logit), scale_0..2 (log
of the standard deviations, m), rot_0..3 (quaternion w, x, y, z); float32, little endian. Where colours change with the
line of sight, also f_rest_0..44: harmonics up to degree 3 as viewers expect them, of which only degree 1 is not zero.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.errors import InputError
from carstudio.export.axes import gltf_from_canonical
from carstudio.files import write_bytes
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from carstudio.rendering.gaussians.cloud import GaussianCloud

SH_CONSTANT = 0.28209479177387814  # of degree 0: 1 / (2 sqrt(pi))
SH_LINEAR = 0.4886025119029199  # of degree 1: sqrt(3 / (4 pi)); its terms are -y, z, -x
NUM_REST = 15  # harmonics of degrees 1 to 3, per channel
REST = tuple(f"f_rest_{i}" for i in range(3 * NUM_REST))
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_LEAST_OPACITY = 1e-6  # a logit must be finite
_LEAST_SCALE_M = 1e-6
MAX_SPLATS = 10_000_000


@dataclass(frozen=True)
class MetricSplats:
    """Gaussians of one car in glTF's axes: means and standard deviations in metres."""

    mean: Float[Tensor, "splat 3"]
    scale: Float[Tensor, "splat 3"]
    quaternion: Float[Tensor, "splat 4"]
    opacity: Float[Tensor, " splat"]
    rgb: Float[Tensor, "splat 3"]
    tint: Float[Tensor, "splat 3 3"] | None = None
    """Change of each channel with the unit line of sight (glTF's axes); None: none."""


def metric_splats(cloud: GaussianCloud, size: Float[Tensor, "3"]) -> MetricSplats:
    """A car's cloud (batch of one) carried from its canonical box: mean A mu + b, covariance A Sigma A^T.

    The box is scaled differently along its axes, so scales and rotations come from an eigenvalue decomposition. Of the
    cloud's light only what is alike from everywhere is kept: how bright photos of each side were is left out.
    """
    usual = 1.0 if cloud.light is None else torch.exp(cloud.light[0, 0])
    linear, shift = gltf_from_canonical(size.double())
    covariance = linear @ cloud.covariance().matrix()[0].double() @ linear.T
    variance, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()  # a rotation, not a mirror
    return MetricSplats(
        mean=(cloud.mean[0].double() @ linear.T + shift).float(),
        scale=variance.clamp(min=_LEAST_SCALE_M**2).sqrt().float(),
        quaternion=quaternion_from_rotation(axes).float(),
        opacity=cloud.opacity[0],
        rgb=(cloud.rgb[0] * usual).clamp(max=1),
        tint=None if cloud.tint is None else (cloud.tint[0].mT * usual).mT @ sight_map(size).float(),
    )


def sight_map(size: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The matrix that best turns a metric line of sight (glTF's axes) into the canonical one, both unit vectors.

    Exactly it is A^-1 d over its length, which no harmonic of degree 1 can be; by least squares over all directions.
    """
    linear, _ = gltf_from_canonical(size.double())
    height = torch.linspace(-1, 1, 2001, dtype=torch.float64)[1:-1]
    angle = torch.arange(len(height), dtype=torch.float64) * torch.pi * (3 - 5**0.5)
    across = (1 - height**2).sqrt()
    metric = torch.stack([across * angle.cos(), height, across * angle.sin()], dim=-1)
    canonical = torch.nn.functional.normalize(metric @ torch.linalg.inv(linear).T, dim=-1)
    return torch.linalg.lstsq(metric, canonical).solution.T


def write_ply(path: Path, splats: MetricSplats) -> None:
    """Write the file, atomically."""
    opacity = splats.opacity.clamp(_LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = torch.cat(
        [
            splats.mean,
            torch.zeros_like(splats.mean),
            (splats.rgb - 0.5) / SH_CONSTANT,
            torch.logit(opacity)[:, None],
            splats.scale.log(),
            splats.quaternion,
        ],
        dim=1,
    )
    names: tuple[str, ...] = PROPERTIES
    if splats.tint is not None:
        rest = torch.zeros(len(columns), 3, NUM_REST)
        rest[..., :3] = splats.tint[..., [1, 2, 0]] * columns.new_tensor([-1.0, 1.0, -1.0]) / SH_LINEAR
        columns, names = torch.cat([columns, rest.flatten(1)], dim=1), (*PROPERTIES, *REST)
    values = columns.detach().cpu().numpy().astype("<f4")
    write_bytes(path, _header(len(values), names).encode() + values.tobytes())


def read_ply(path: Path) -> MetricSplats:
    """Inverse of `write_ply`; harmonics above degree 1 are left out. `InputError` for other files."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    head, end, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    names = [line.split()[-1] for line in lines if line.startswith("property float ")]
    counts = [line.split()[-1] for line in lines if line.startswith("element vertex ")]
    if not end or "format binary_little_endian 1.0" not in lines or len(counts) != 1 or not counts[0].isdecimal():
        raise InputError(f"{path}: expected a binary splat PLY of one element `vertex`, found another file")
    missing = [name for name in PROPERTIES if name not in names]
    count = int(counts[0])
    if missing or count > MAX_SPLATS or len(body) < 4 * count * len(names):
        raise InputError(f"{path}: expected {count} splats with {', '.join(PROPERTIES)}; missing {missing}, or cut off")
    table = np.frombuffer(body, "<f4", count * len(names)).reshape(count, len(names)).copy()
    value = {name: torch.from_numpy(table[:, [names.index(name)]]) for name in PROPERTIES}

    def join(*wanted: str) -> Tensor:
        return torch.cat([value[name] for name in wanted], dim=1)

    return MetricSplats(
        mean=join("x", "y", "z"),
        scale=join("scale_0", "scale_1", "scale_2").exp(),
        quaternion=torch.nn.functional.normalize(join("rot_0", "rot_1", "rot_2", "rot_3"), dim=-1),
        opacity=torch.sigmoid(value["opacity"][:, 0]),
        rgb=join("f_dc_0", "f_dc_1", "f_dc_2") * SH_CONSTANT + 0.5,
        tint=_read_tint(table, names),
    )


def _read_tint(table: np.ndarray, names: list[str]) -> Float[Tensor, "splat 3 3"] | None:
    if not set(REST) <= set(names):
        return None
    columns = [names.index(f"f_rest_{channel * NUM_REST + term}") for channel in range(3) for term in range(3)]
    rest = torch.from_numpy(table[:, columns]).unflatten(1, (3, 3)) * torch.tensor([-1.0, 1.0, -1.0]) * SH_LINEAR
    return rest[..., [2, 0, 1]]


def canonical_cloud(splats: MetricSplats, size: Float[Tensor, "3"]) -> GaussianCloud:
    """Splats of a file back in the canonical box of a car of `size`: inverse of `metric_splats`."""
    linear, shift = gltf_from_canonical(size.double())
    back = torch.linalg.inv(linear)
    axes = rotation_from_quaternion(splats.quaternion.double()) * splats.scale.double()[:, None]
    variance, turn = torch.linalg.eigh(back @ (axes @ axes.mT) @ back.T)
    turn = turn * torch.linalg.det(turn)[:, None, None].sign()
    return GaussianCloud(
        mean=((splats.mean.double() - shift) @ back.T).float()[None],
        log_scale=(variance.clamp(min=1e-16).log() / 2).float()[None],
        quaternion=quaternion_from_rotation(turn).float()[None],
        opacity=splats.opacity[None],
        rgb=splats.rgb[None],
        tint=None if splats.tint is None else (splats.tint @ torch.linalg.inv(sight_map(size)).float())[None],
    )


def _header(count: int, names: tuple[str, ...]) -> str:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment a car in metres, +Y up, +Z front, ground at Y = 0",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header",
        "",
    ]
    return "\n".join(lines)
