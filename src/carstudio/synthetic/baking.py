"""Diffuse sky light, worked out once per car and light and used by all its views: on the car and on the ground.

Cosine-weighted rays from every vertex (and from a grid on the ground) gather the surroundings; where the car itself is
in the way they gather little. All points use one set of directions, each in its own frame, so that there is no grain.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.light import Colours, Light
from carstudio.synthetic.street import Street, ambient
from carstudio.synthetic.tracing import Tracer

VERTEX_RAYS = 40
GROUND_RAYS = 96
SELF_LIGHT = 0.06  # radiance of the car's own surfaces seen by such a ray, relative to the horizon's
LIFT_M = 0.012  # rays start this far above the surface


def cosine_directions(num: int) -> Float[np.ndarray, "n 3"]:
    """Evenly spread directions about +z with density proportional to the cosine (Fibonacci points on the disc)."""
    i = np.arange(num)
    radius, angle = np.sqrt((i + 0.5) / num), i * np.pi * (3 - np.sqrt(5))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=-1)


def frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations whose third column is the normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.7, np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9)
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=-1)


def gather(
    tracer: Tracer,
    street: Street,
    light: Light,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    num_rays: int,
) -> Colours:
    """Irradiance from everything but the sun at points with normals."""
    local = cosine_directions(num_rays)
    directions = np.einsum("nij,kj->nki", frames(normals), local).reshape(-1, 3).astype(np.float32)
    origins = np.repeat((points + LIFT_M * normals).astype(np.float32), num_rays, axis=0)
    incoming = ambient(street, light, directions)
    incoming[tracer.is_occluded(origins, directions)] = SELF_LIGHT * light.horizon
    return (np.pi * incoming.reshape(len(points), num_rays, 3).mean(axis=1)).astype(np.float32)


@dataclass(frozen=True)
class Baked:
    """Irradiance per vertex, and on the ground over a grid of cells around the car (nothing known outside)."""

    vertex: Float[np.ndarray, "vertices 3"]
    ground: Float[np.ndarray, "rows columns 3"]
    reach: tuple[float, float]  # the grid covers |x| <= reach[0], |z| <= reach[1]
    tracer: Tracer
    light: Light

    def ground_light(self, points: Float[np.ndarray, "n 3"]) -> Colours:
        """Irradiance on the ground with the car's shadow."""
        rows, columns = self.ground.shape[:2]
        a = (points[:, 0] / self.reach[0] + 1) / 2 * (rows - 1)
        b = (points[:, 2] / self.reach[1] + 1) / 2 * (columns - 1)
        i, j = (np.clip(v, 0, n - 1.001) for v, n in ((a, rows), (b, columns)))
        i0, j0 = i.astype(int), j.astype(int)
        wi, wj = (i - i0)[:, None], (j - j0)[:, None]
        sky = (self.ground[i0, j0] * (1 - wj) + self.ground[i0, j0 + 1] * wj) * (1 - wi)
        sky = sky + (self.ground[i0 + 1, j0] * (1 - wj) + self.ground[i0 + 1, j0 + 1] * wj) * wi
        near = np.flatnonzero(
            np.linalg.norm(points[:, [0, 2]], axis=-1) < 9.0
        )  # a shadow of 20 degrees' sun ends there
        lit = np.ones(len(points), bool)
        to_sun = np.broadcast_to(self.light.to_sun, (len(near), 3))
        lit[near] = ~self.tracer.is_occluded(points[near] - np.array([0, 0.004, 0]), to_sun)
        sun = self.light.sun * max(-float(self.light.to_sun[1]), 0)
        return (sky + lit[:, None] * sun).astype(np.float32)


def bake(tracer: Tracer, street: Street, light: Light) -> Baked:
    """Sky light on the car and on the ground around it."""
    mesh = tracer.mesh
    vertex = gather(tracer, street, light, mesh.vertices, mesh.normals, VERTEX_RAYS)
    length, _, width = mesh.size
    reach = (float(length / 2 + 2.0), float(width / 2 + 2.0))
    x, z = np.meshgrid(np.linspace(-reach[0], reach[0], 44), np.linspace(-reach[1], reach[1], 30), indexing="ij")
    points = np.stack([x, np.full_like(x, street.ground_y), z], axis=-1).reshape(-1, 3)
    up = np.broadcast_to(np.array([0.0, -1.0, 0.0]), points.shape)
    ground = gather(tracer, street, light, points, up, GROUND_RAYS).reshape(*x.shape, 3)
    return Baked(vertex, ground, reach, tracer, light)
