"""Splat PLY as 3-D Gaussian viewers read it (the format of Kerbl et al., 2023), in glTF's axes and metres.

Per Gaussian: x y z, normals (0), f_dc_0..2 (rgb as the constant spherical harmonic), opacity (logit), scale_0..2 (log
of the standard deviations, m), rot_0..3 (quaternion w, x, y, z); float32, little endian. Where colours change with the
direction from which the car is seen, also f_rest_0..44: harmonics of degrees 1 to 3, channel by channel.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.errors import InputError
from carstudio.export.axes import gltf_from_canonical
from carstudio.export.harmonics import NUM_TERMS, SH_CONSTANT, directions_around, fitted, harmonics
from carstudio.files import write_bytes
from carstudio.geometry.transforms import quaternion_from_rotation, rotation_from_quaternion
from carstudio.rendering.gaussians.cloud import GaussianCloud

REST = tuple(f"f_rest_{i}" for i in range(3 * (NUM_TERMS - 1)))
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_LEAST_OPACITY = 1e-6  # a logit must be finite
_LEAST_SCALE_M = 1e-6
MAX_SPLATS = 10_000_000
_CAMERAS = 400  # around the car, from which colours are looked up,
_DISTANCES = (2.0, 5.0)  # at so many lengths of the car from its middle
_BELOW = 0.05  # how much a camera lower than that counts beside one above


@dataclass(frozen=True)
class MetricSplats:
    """Gaussians of one car in glTF's axes: means and standard deviations in metres."""

    mean: Float[Tensor, "splat 3"]
    scale: Float[Tensor, "splat 3"]
    quaternion: Float[Tensor, "splat 4"]
    opacity: Float[Tensor, " splat"]
    colours: Float[Tensor, "splat 3 terms"]
    """Coefficients of `harmonics` for each channel less 1/2; 16 terms, or the constant one alone."""

    def colour_from(self, eye: Float[Tensor, "3"]) -> Float[Tensor, "splat 3"]:
        """What a viewer with its camera there (m) shows."""
        sight = torch.nn.functional.normalize(self.mean - eye, dim=-1)
        terms = harmonics(sight)[:, None, : self.colours.shape[-1]]
        return ((self.colours * terms).sum(dim=-1) + 0.5).clamp(0, 1)


def metric_splats(cloud: GaussianCloud, size: Float[Tensor, "3"]) -> MetricSplats:
    """A car's cloud (batch of one) carried from its canonical box: mean A mu + b, covariance A Sigma A^T.

    The box is scaled differently along its axes, so scales and rotations come from an eigenvalue decomposition. Colours
    that change with the direction (tint and light) are fitted to what cameras around the car see.
    """
    linear, shift = gltf_from_canonical(size.double())
    covariance = linear @ cloud.covariance().matrix()[0].double() @ linear.T
    variance, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()  # a rotation, not a mirror
    mean = cloud.mean[0].double() @ linear.T + shift
    if cloud.tint is None and cloud.light is None:
        colours = (cloud.rgb[0, ..., None] - 0.5) / SH_CONSTANT
    else:
        toward = directions_around(_CAMERAS).to(mean)
        eyes = torch.cat([toward * share * size[0] for share in _DISTANCES])
        canonical = (eyes @ torch.linalg.inv(linear).T).to(cloud.rgb)
        seen = torch.cat([cloud.colour_from(eye) for eye in canonical[:, None]])
        sight = torch.nn.functional.normalize(mean - shift - eyes[:, None], dim=-1)
        colours = fitted(sight, torch.where(eyes[:, 1] > 0, 1.0, _BELOW).to(mean), seen.double() - 0.5)
    return MetricSplats(
        mean=mean.float(),
        scale=variance.clamp(min=_LEAST_SCALE_M**2).sqrt().float(),
        quaternion=quaternion_from_rotation(axes).float(),
        opacity=cloud.opacity[0],
        colours=colours.float(),
    )


def write_ply(path: Path, splats: MetricSplats) -> None:
    """Write the file, atomically."""
    opacity = splats.opacity.clamp(_LEAST_OPACITY, 1 - _LEAST_OPACITY)
    columns = torch.cat(
        [
            splats.mean,
            torch.zeros_like(splats.mean),
            splats.colours[..., 0],
            torch.logit(opacity)[:, None],
            splats.scale.log(),
            splats.quaternion,
        ],
        dim=1,
    )
    names: tuple[str, ...] = PROPERTIES
    if splats.colours.shape[-1] > 1:
        columns, names = torch.cat([columns, splats.colours[..., 1:].flatten(1)], dim=1), (*PROPERTIES, *REST)
    values = columns.detach().cpu().numpy().astype("<f4")
    write_bytes(path, _header(len(values), names).encode() + values.tobytes())


def read_ply(path: Path) -> MetricSplats:
    """Inverse of `write_ply`. `InputError` for other files."""
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
        colours=torch.cat([join("f_dc_0", "f_dc_1", "f_dc_2")[..., None], *_rest(table, names)], dim=-1),
    )


def _rest(table: np.ndarray, names: list[str]) -> list[Float[Tensor, "splat 3 15"]]:
    """Harmonics above the constant, where the file has all of them."""
    if not set(REST) <= set(names):
        return []
    return [torch.from_numpy(table[:, [names.index(name) for name in REST]]).unflatten(1, (3, -1))]


def canonical_cloud(splats: MetricSplats, size: Float[Tensor, "3"], eye: Float[Tensor, "3"]) -> GaussianCloud:
    """Splats of a file back in the canonical box of a car of `size`, in the colours that a camera at `eye` (m) sees."""
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
        rgb=splats.colour_from(eye)[None],
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
