"""Triangle surfaces with smooth normals, materials and painted charts: the pieces a car mesh is put together from.

Design frame, used while a car is built: x to the front, h up from the ground, z to the car's left, metres, as columns
(x, h, z). `car_mesh` turns it into the car frame (x front, y down, z left, origin = centre of the exact bounding box).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Integer, UInt8

from carstudio.synthetic.materials import Material

NO_CHART = -1
# Finish of every texel from its position (x, h, z; z >= 0 on charts of half a car).
Painter = Callable[[Float[np.ndarray, "rows columns 3"]], UInt8[np.ndarray, "rows columns"]]


@dataclass(frozen=True)
class Chart:
    """A texture: `finish` holds material indices; or `rgb` linear colours (of a scanned or downloaded mesh)."""

    finish: UInt8[np.ndarray, "rows columns"] | None = None
    rgb: Float[np.ndarray, "rows columns 3"] | None = None


@dataclass(frozen=True)
class Part:
    """A surface. `uv` in [0, 1]^2: u along the chart's rows, v along its columns (texel centres at +0.5)."""

    vertices: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    faces: Integer[np.ndarray, "m 3"]
    material: Integer[np.ndarray, " m"]
    chart: Chart | None = None

    def mirrored(self) -> "Part":
        """The same on the car's other side (z negated), facing outwards again."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(
            self, vertices=self.vertices * flip, normals=self.normals * flip, faces=self.faces[:, ::-1].copy()
        )

    def without(self, is_cut: Bool[np.ndarray, " m"]) -> "Part":
        """The part less some faces."""
        return replace(self, faces=self.faces[~is_cut], material=self.material[~is_cut])

    def moved(self, x: float, h: float, z: float) -> "Part":
        """Shifted."""
        return replace(self, vertices=self.vertices + np.array([x, h, z]))

    @property
    def centroids(self) -> Float[np.ndarray, "m 3"]:
        """Centre of every face."""
        return self.vertices[self.faces].mean(axis=1)


@dataclass(frozen=True)
class CarMesh:
    """A car in the car frame, its materials and charts. The 3-D box is the exact bounding box of all of it, mirrors
    included (ours stick out by a few cm only, so that the box stays close to the tight boxes of KITTI).
    """

    vertices: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    faces: Integer[np.ndarray, "m 3"]
    face_material: Integer[np.ndarray, " m"]
    face_chart: Integer[np.ndarray, " m"]
    charts: tuple[Chart, ...]
    materials: tuple[Material, ...]
    colours: Float[np.ndarray, "n 3"] | None = None
    """Per vertex, linear, multiplied with the material's or chart's colour; None: white."""

    @property
    def size(self) -> Float[np.ndarray, "3"]:
        """Length, height, width of the exact bounding box, m."""
        return self.vertices.max(axis=0) - self.vertices.min(axis=0)


def grid_part(
    points: Float[np.ndarray, "rows columns 3"],
    *,
    outside: Float[np.ndarray, "*#grid 3"] | None = None,
    material: int = 0,
    painter: Painter | None = None,
    texels: tuple[int, int] = (512, 128),
    seam_z: bool = False,
) -> Part:
    """The surface through a grid of points, smooth inside.

    Normals point away from `outside` reversed: on average away from the grid's axis (None: away from the line h = mean
    h, z = 0 of the grid) or along the given direction. `seam_z`: the first and last rows lie on the plane z = 0 where
    the mirrored half continues, so normals there have no z.
    """
    rows, columns = points.shape[:2]
    normals = _grid_normals(points)
    reference = points - np.array([0.0, float(points[..., 1].mean()), 0.0]) if outside is None else outside
    if outside is None:
        reference = reference - np.array([float(points[..., 0].mean()), 0.0, 0.0])
    is_inward = float((normals * reference).sum()) < 0
    if is_inward:
        normals = -normals
    is_point = np.linalg.norm(normals, axis=-1, keepdims=True) < 0.5  # the grid closes to a point there
    away = reference / np.maximum(np.linalg.norm(reference, axis=-1, keepdims=True), 1e-9)
    normals = np.where(is_point, away, normals)
    if seam_z:
        for row in (0, -1):
            normals[row, :, 2] = 0
        normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    if is_inward:
        faces = faces[:, ::-1].copy()
    u, v = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    chart = None if painter is None else Chart(finish=painter(resample_grid(points, texels)))
    return Part(
        points.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.stack([u, v], -1).reshape(-1, 2),
        faces,
        np.full(len(faces), material),
        chart,
    )


def _grid_normals(points: Float[np.ndarray, "rows columns 3"]) -> Float[np.ndarray, "rows columns 3"]:
    """Unit normals by finite differences; where the grid closes to a point, those of the neighbours."""
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.maximum(length, 1e-12)


def resample_grid(
    points: Float[np.ndarray, "rows columns 3"], texels: tuple[int, int]
) -> Float[np.ndarray, "texel_rows texel_columns 3"]:
    """Positions of texel centres on the grid's surface, bilinear."""
    for axis, count in enumerate(texels):
        at = (np.arange(count) + 0.5) / count * (points.shape[axis] - 1)
        low = np.minimum(at.astype(int), points.shape[axis] - 2)
        weight = (at - low).reshape([-1 if i == axis else 1 for i in range(3)])
        points = np.take(points, low, axis) * (1 - weight) + np.take(points, low + 1, axis) * weight
    return points


def both_sides(part: Part) -> list[Part]:
    """A left part and its mirror image."""
    return [part, part.mirrored()]


def car_mesh(parts: Sequence[Part], materials: tuple[Material, ...]) -> CarMesh:
    """All parts as one mesh in the car frame, centred on its exact bounding box."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    charts: list[Chart] = []
    face_chart = []
    for part in parts:
        if part.chart is None:
            face_chart.append(np.full(len(part.faces), NO_CHART))
            continue
        known = next((i for i, chart in enumerate(charts) if chart is part.chart), len(charts))
        if known == len(charts):
            charts.append(part.chart)
        face_chart.append(np.full(len(part.faces), known))
    to_car = np.array([1.0, -1.0, 1.0])  # h up becomes y down; (x, h, z) is left-handed, so the windings turn right
    vertices = np.concatenate([part.vertices for part in parts]) * to_car
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    used = np.unique(faces)
    low, high = vertices[used].min(axis=0), vertices[used].max(axis=0)
    renumber = np.zeros(len(vertices), int)
    renumber[used] = np.arange(len(used))
    return CarMesh(
        (vertices - (low + high) / 2)[used],
        (np.concatenate([part.normals for part in parts]) * to_car)[used],
        np.concatenate([part.uv for part in parts])[used],
        renumber[faces][:, ::-1].copy(),
        np.concatenate([part.material for part in parts]),
        np.concatenate(face_chart),
        tuple(charts),
        materials,
    )
