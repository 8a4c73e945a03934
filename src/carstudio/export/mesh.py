"""A textured surface of any category model: views from all around, fused, and coloured by what they saw.

Depth of each view goes into a truncated signed distance (Curless and Levoy, 1996) on a grid over the car's box;
marching cubes finds its surface; a vertex gets the mean colour of the views that see it, weighted by how squarely they
do.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from skimage.measure import marching_cubes
from torch import Tensor

from carstudio.errors import InputError
from carstudio.export.axes import gltf_from_canonical
from carstudio.files import write_bytes
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera, orbit_distance
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.progress import Report, silent

_SEEN_OPACITY = 0.5


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """How fine a mesh is."""

    grid: int = 128
    """Cells along the car's length; the others in proportion to its size."""
    views: int = 42
    """Photographs taken, evenly over the upper hemisphere and a little below."""
    view_px: int = 192
    """Side of a photograph."""

    def __post_init__(self) -> None:
        if not 16 <= self.grid <= 512 or not 6 <= self.views <= 1000 or not 32 <= self.view_px <= 2048:
            raise InputError(
                f"a mesh needs a grid of 16 to 512 cells, 6 to 1000 views of 32 to 2048 px, found {self.grid}, "
                f"{self.views}, {self.view_px}"
            )


@dataclass(frozen=True)
class View:
    """One rendering: the box's place in the camera, and rgb (straight, not premultiplied), opacity, depth (m)."""

    box: Box3D
    camera: Camera
    rgb: Float[Tensor, "height width 3"]
    opacity: Float[Tensor, "height width"]
    depth_m: Float[Tensor, "height width"]


@dataclass(frozen=True)
class Surface:
    """Triangles in the car frame (x front, y down, z left, m), rgb in [0, 1] per vertex, wound to face outwards."""

    vertices: Float[np.ndarray, "vertex 3"]
    faces: np.ndarray
    rgb: Float[np.ndarray, "vertex 3"]


def directions(count: int, lowest_deg: float = -15.0) -> list[tuple[float, float]]:
    """(azimuth, elevation) in degrees, evenly over the sphere above `lowest_deg`, on a Fibonacci spiral."""
    low = math.sin(math.radians(lowest_deg))
    golden = math.pi * (3 - math.sqrt(5))
    return [
        (math.degrees(i * golden) % 360, math.degrees(math.asin(low + (1 - low) * (i + 0.5) / count)))
        for i in range(count)
    ]


def take_views(
    model: CategoryModel, latents: Latents, size: Float[Tensor, "3"], config: MeshConfig, report: Report = silent
) -> list[View]:
    """Renderings of one car (latents: batch of one) from all around."""
    camera, distance = orbit_camera(config.view_px), orbit_distance(size)
    views = []
    for done, (azimuth, elevation) in enumerate(directions(config.views), start=1):
        box = orbit_box(size, azimuth_deg=azimuth, elevation_deg=elevation, distance_m=distance)
        batch = Box3D(box.center[None], box.size[None], box.rotation[None]).to(latents.shape.device)
        image = render_image(model, camera.to(latents.shape.device), latents, batch)
        opacity = image["opacity"].cpu()
        rgb = image["rgb"].cpu() / opacity.clamp(min=1e-3)[..., None]
        views.append(View(box, camera, rgb.clamp(0, 1), opacity, image["depth_m"].cpu()))
        report("views", done, config.views, "")
    return views


def fuse(views: list[View], size: Float[Tensor, "3"], grid: int) -> Surface:
    """The surface that the views agree on; `InputError` when they saw nothing."""
    step = float(size.max()) / grid
    counts = [max(4, math.ceil(float(side) / step)) + 3 for side in size]
    low = -size / 2 - 1.5 * step
    axes = [low[i] + step * torch.arange(counts[i]) for i in range(3)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    distance = _fused_distance(views, points, truncation=3 * step).reshape(counts)
    if not bool((distance < 0).any()):
        raise InputError("the model shows no car here: nothing to make a mesh of; train it longer, or take another car")
    vertices, faces, normals, _ = marching_cubes(distance.numpy(), level=0.0, spacing=(step, step, step))
    vertices = vertices + low.numpy()
    rgb = _colours(views, torch.from_numpy(vertices.astype(np.float32)), torch.from_numpy(normals.copy()), 2 * step)
    return Surface(vertices.astype(np.float32), faces.astype(np.int64), rgb.numpy())


def _fused_distance(views: list[View], points: Float[Tensor, "n 3"], truncation: float) -> Float[Tensor, " n"]:
    """Mean truncated distance to the seen surface along the views' rays, positive outside; unseen is inside.

    A view that looks past the car at a point says that it is outside, which carves the silhouette.
    """
    total, weight = torch.zeros(len(points)), torch.zeros(len(points))
    is_carved = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        pixels, depth = _project(points, view)
        opacity, surface = _sample(view.opacity, pixels), _sample(view.depth_m, pixels, view.opacity)
        seen = opacity > _SEEN_OPACITY
        is_carved |= opacity < 0.5 * _SEEN_OPACITY
        signed = (surface - depth).clamp(max=truncation)
        counts = seen & (signed > -truncation)
        total += torch.where(counts, signed, torch.zeros(()))
        weight += counts.float()
    distance = torch.where(weight > 0, total / weight.clamp(min=1), torch.full((), -truncation))
    return torch.where(is_carved, distance.clamp(min=0.25 * truncation), distance)


def _colours(
    views: list[View], points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], tolerance_m: float
) -> Float[Tensor, "n 3"]:
    """Mean colour of the views in which a point is in front, weighted by the cosine to its normal."""
    total, weight = torch.zeros(len(points), 3), torch.full((len(points), 1), 1e-8)
    for view in views:
        pixels, depth = _project(points, view)
        is_front = (depth < _sample(view.depth_m, pixels, view.opacity) + tolerance_m) & (
            _sample(view.opacity, pixels) > _SEEN_OPACITY
        )
        eye = -(view.box.center @ view.box.rotation)  # of the camera, in the car frame
        facing = (torch.nn.functional.normalize(eye - points, dim=-1) * normals).sum(dim=-1).clamp(min=0.02) ** 2
        share = (facing * is_front)[:, None]
        total += share * _sample(view.rgb, pixels)
        weight += share
    return (total / weight).clamp(0, 1)


def _project(points: Float[Tensor, "n 3"], view: View) -> tuple[Float[Tensor, "n 2"], Float[Tensor, " n"]]:
    in_camera = points @ view.box.rotation.T + view.box.center
    return view.camera.project(in_camera), in_camera[:, 2]


def _sample(
    picture: Float[Tensor, "height width *channel"], pixels: Float[Tensor, "n 2"], weight: Tensor | None = None
) -> Tensor:
    """Bilinear values at positions (px, pixel centres at +0.5), 0 outside; with `weight`, of the weighted picture."""
    height, width = picture.shape[:2]
    values = picture.reshape(height, width, -1)
    if weight is not None:
        values = torch.cat([values * weight[..., None], weight[..., None]], dim=-1)
    place = 2 * pixels / pixels.new_tensor([width, height]) - 1
    found = torch.nn.functional.grid_sample(
        values.permute(2, 0, 1)[None], place[None, None], mode="bilinear", align_corners=False
    )[0, :, 0].T
    if weight is not None:
        found = found[:, :-1] / found[:, -1:].clamp(min=1e-6)
    return found[:, 0] if picture.dim() == 2 else found


def write_glb(path: Path, surface: Surface, size: Float[Tensor, "3"], name: str) -> None:
    """A GLB with vertex colours in glTF's axes, metres, ground at Y = 0."""
    linear, shift = gltf_from_canonical(size.double())
    to_gltf = (linear @ torch.diag(2 / size.double())).numpy()  # of the car frame: a rotation
    vertices = surface.vertices.astype(np.float64) @ to_gltf.T + shift.numpy()
    # glTF's COLOR_0 is linear; ours are display values.
    linear_rgb = np.where(surface.rgb <= 0.04045, surface.rgb / 12.92, ((surface.rgb + 0.055) / 1.055) ** 2.4)
    colours = np.concatenate([linear_rgb, np.ones((len(linear_rgb), 1))], axis=1)
    mesh = trimesh.Trimesh(
        vertices=vertices, faces=surface.faces, vertex_colors=(colours * 255).round().astype(np.uint8), process=False
    )
    scene = trimesh.Scene(mesh)
    scene.metadata["name"] = name
    write_bytes(path, scene.export(file_type="glb"))
