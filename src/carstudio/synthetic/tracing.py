"""Rays against a car mesh with embree: first hits, occlusion, and what the surface is like where a ray meets it.

Everything is in the car frame, metres; one `Tracer` per process and car (embree scenes cannot be pickled).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Integer

from carstudio.synthetic.surfaces import CarMesh

Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Hits:
    """First hits of the rays that meet the car. `ray` numbers them among those cast; `distance` is in units of the
    ray's direction; `weights` are the barycentric weights of the face's corners.
    """

    ray: Integer[np.ndarray, " m"]
    face: Integer[np.ndarray, " m"]
    distance: Float[np.ndarray, " m"]
    weights: Float[np.ndarray, "m 3"]


@dataclass(frozen=True)
class Surface:
    """The car's surface at some hits: smooth normal and material (linear colours; see `Material`)."""

    normal: Float[np.ndarray, "m 3"]
    rgb: Float[np.ndarray, "m 3"]
    specular: Float[np.ndarray, " m"]
    mirror: Float[np.ndarray, " m"]
    metallic: Float[np.ndarray, " m"]


class Tracer:
    """An embree scene of one car."""

    def __init__(self, mesh: CarMesh) -> None:
        self.mesh = mesh
        self._scene: Any = EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
        self._rgb = np.array([material.rgb for material in mesh.materials], np.float32)
        self._gloss = np.array([(m.specular, m.mirror, m.metallic) for m in mesh.materials], np.float32)
        self._normals = mesh.normals.astype(np.float32)
        self._uv = mesh.uv.astype(np.float32)

    def first_hits(self, origins: Points, directions: Points) -> Hits:
        """Where rays first meet the car."""
        out = self._scene.run(_float32(origins), _float32(directions), output=True)
        ray = np.flatnonzero(out["primID"] >= 0)
        u, v = out["u"][ray], out["v"][ray]
        return Hits(ray, out["primID"][ray], out["tfar"][ray], np.stack([1 - u - v, u, v], axis=-1))

    def is_occluded(self, origins: Points, directions: Points) -> Bool[np.ndarray, " n"]:
        """Whether anything of the car lies on the rays."""
        if len(origins) == 0:
            return np.zeros(0, bool)
        hit: Any = self._scene.run(_float32(origins), _float32(directions), query="OCCLUDED")
        return np.asarray(hit >= 0)

    def interpolate(self, values: Float[np.ndarray, "vertices d"], hits: Hits) -> Float[np.ndarray, "m d"]:
        """Values given per vertex, at the hits."""
        corners = values[self.mesh.faces[hits.face]]
        return np.einsum("mkd,mk->md", corners, hits.weights)

    def surface(self, hits: Hits) -> Surface:
        """Normals and materials at the hits."""
        normal = self.interpolate(self._normals, hits)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
        material = self.mesh.face_material[hits.face].copy()
        uv = self.interpolate(self._uv, hits)
        chart_of_hit = self.mesh.face_chart[hits.face]
        sampled: list[tuple[Any, Any]] = []
        for index, chart in enumerate(self.mesh.charts):
            mine = np.flatnonzero(chart_of_hit == index)
            if len(mine) == 0:
                continue
            if chart.finish is not None:
                material[mine] = _nearest(chart.finish, uv[mine])
            if chart.rgb is not None:
                sampled.append((mine, _nearest(chart.rgb, uv[mine])))
        rgb = self._rgb[material]
        for mine, colours in sampled:
            rgb[mine] = colours
        if self.mesh.colours is not None:
            rgb = rgb * self.interpolate(self.mesh.colours.astype(np.float32), hits)
        specular, mirror, metallic = self._gloss[material].T
        return Surface(normal, rgb, specular, mirror, metallic)


def _float32(values: Points) -> Any:
    return np.ascontiguousarray(values, np.float32)


def _nearest(texels: np.ndarray, uv: Float[np.ndarray, "m 2"]) -> np.ndarray:
    """Texel under uv (rows along u, columns along v); outside [0, 1] the chart repeats, 1 itself is its last texel."""
    rows, columns = texels.shape[:2]
    uv = np.where((uv >= 0) & (uv <= 1), uv, uv % 1)
    row = np.minimum((uv[:, 0] * rows).astype(int), rows - 1)
    column = np.minimum((uv[:, 1] * columns).astype(int), columns - 1)
    return texels[row, column]
