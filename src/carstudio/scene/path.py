"""The ego path: coordinates along and across the way the camera went.

`along` counts metres from the first posed frame's camera, `left` metres to the path's left, `down` metres below the
camera's way. Before its first and after its last point the path goes straight on. The path's axes are x along, y down,
z left, like a car's.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from carstudio.errors import InputError
from carstudio.scene.graph import Scene
from carstudio.scene.places import Point, posed_frames

_STEP_M = 1.0  # points nearer to each other than this only carry the poses' noise
_STRAIGHT_ON_M = 1000.0
_LEVEL = 0.7  # cosine: how much a world's y axis must point down


@dataclass(frozen=True)
class EgoPath:
    """A polyline in the world: `points` (n, 3), the left normals at them (n, 2: x, z), `along` (n) in metres.

    Between two points the normal turns steadily, so that each place near the path has one pair of coordinates.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 2"]
    along: Float[np.ndarray, " n"]

    def to_path(self, point: Point) -> tuple[Float[np.ndarray, "3"], float]:
        """(along, down, left) of a world point, and the yaw (rad) of the path's x axis there."""
        best: tuple[float, int, float, float] | None = None
        for part in range(len(self.points) - 1):
            for share in self._feet(point, part):
                foot, normal = self._at(part, share)
                left = float((point - foot)[[0, 2]] @ normal)
                if best is None or abs(left) < best[0]:
                    best = (abs(left), part, share, left)
        if best is None:
            raise InputError(f"the place {point.round(1).tolist()} (world, m) lies on no side of the ego path")
        _, part, share, left = best
        foot, normal = self._at(part, share)
        along = self.along[part] + share * (self.along[part + 1] - self.along[part])
        return np.array([along, point[1] - foot[1], left]), _yaw(normal)

    def from_path(self, along: float, down: float, left: float) -> tuple[Point, float]:
        """The world point of path coordinates, and the yaw (rad) of the path's x axis there."""
        part = int(np.clip(np.searchsorted(self.along, along, side="right") - 1, 0, len(self.along) - 2))
        share = float((along - self.along[part]) / (self.along[part + 1] - self.along[part]))
        foot, normal = self._at(part, share)
        return foot + np.array([normal[0] * left, down, normal[1] * left]), _yaw(normal)

    def _at(self, part: int, share: float) -> tuple[Point, Float[np.ndarray, "2"]]:
        foot = self.points[part] + share * (self.points[part + 1] - self.points[part])
        normal = self.normals[part] + share * (self.normals[part + 1] - self.normals[part])
        return foot, normal / np.linalg.norm(normal)

    def _feet(self, point: Point, part: int) -> list[float]:
        """Shares (0 to 1) of a part at which the point lies on the normal: roots of cross(p - C(t), N(t))."""
        away = (point - self.points[part])[[0, 2]]
        step = (self.points[part + 1] - self.points[part])[[0, 2]]
        normal, turn = self.normals[part], self.normals[part + 1] - self.normals[part]
        quadratic = [-_cross(step, turn), _cross(away, turn) - _cross(step, normal), _cross(away, normal)]
        roots = _real_roots(*quadratic)
        return [min(max(root, 0.0), 1.0) for root in roots if -1e-9 <= root <= 1 + 1e-9]


def ego_path(scene: Scene) -> EgoPath | None:
    """The path of a scene's posed frames; None without poses.

    `InputError` when the poses' world does not have y down.
    """
    poses = [pose for _, pose in posed_frames(scene)]
    if not poses:
        return None
    if np.mean([pose[1, 1] for pose in poses]) < _LEVEL:
        raise InputError("the poses' world must have y down, as KITTI odometry's; turn the poses before")
    places = [poses[0][:3, 3]]
    for pose in poses[1:]:
        if np.linalg.norm((pose[:3, 3] - places[-1])[[0, 2]]) >= _STEP_M:
            places.append(pose[:3, 3])
    if len(places) == 1:  # the camera stands: straight on along its axis
        forward = poses[0][:3, 2] * [1, 0, 1]
        places.append(places[0] + forward / np.linalg.norm(forward))
    ways = [b - a for a, b in pairwise(places)]
    first, last = (way / np.linalg.norm(way[[0, 2]]) * _STRAIGHT_ON_M for way in (ways[0], ways[-1]))
    points = np.array([places[0] - first, *places, places[-1] + last])
    steps = np.diff(points, axis=0)[:, [0, 2]]
    tangents = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    at_points = np.concatenate([tangents[:1], tangents[:-1] + tangents[1:], tangents[-1:]])
    at_points /= np.linalg.norm(at_points, axis=1, keepdims=True)
    normals = np.stack([-at_points[:, 1], at_points[:, 0]], axis=1)  # left of (x, z) seen with y down
    along = np.concatenate([[0.0], np.linalg.norm(steps, axis=1).cumsum()]) - _STRAIGHT_ON_M
    return EgoPath(points, normals, along)


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _real_roots(a: float, b: float, c: float) -> list[float]:
    """Real roots of a t^2 + b t + c, without cancellation."""
    if abs(a) < 1e-12 * max(abs(b), 1e-300):
        return [-c / b] if b else []
    inside = b * b - 4 * a * c
    if inside < 0:
        return []
    q = -(b + math.copysign(math.sqrt(inside), b)) / 2
    return [q / a] + ([c / q] if q else [])


def _yaw(normal: np.ndarray) -> float:
    """Yaw of the path's x axis: KITTI's rotation about y that carries x to the tangent."""
    tangent_x, tangent_z = normal[1], -normal[0]
    return math.atan2(-tangent_z, tangent_x)
