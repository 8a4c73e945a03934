"""Ray against triangles, one by one (Moeller and Trumbore 1997), float64."""

import numpy as np


def first_hit(origin: np.ndarray, direction: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest positive parameter at which the ray meets a triangle (n, 3, 3); infinite where it meets none."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    edge1, edge2 = b - a, c - a
    p = np.cross(direction, edge2)
    determinant = (edge1 * p).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        t_vec = origin - a
        u = (t_vec * p).sum(-1) / determinant
        q = np.cross(t_vec, edge1)
        v = (q @ direction) / determinant
        t = (edge2 * q).sum(-1) / determinant
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9)
    return float(t[hit].min()) if hit.any() else float("inf")
