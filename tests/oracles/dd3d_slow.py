"""DD3D's decoding and suppression written out slowly in float64: loops over cells, angles, clipped polygons."""

import math
from collections.abc import Sequence

import numpy as np

Point = tuple[float, float]


def turn(axis: int, angle: float) -> np.ndarray:
    """Rotation about x, y or z by the right-hand rule."""
    c, s = math.cos(angle), math.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def pointed_at(ray: np.ndarray) -> np.ndarray:
    """A camera turned to look along `ray`: first to its side by an angle about y, then up or down about its own x."""
    x, y, z = ray / np.linalg.norm(ray)
    return turn(1, math.atan2(x, z)) @ turn(0, -math.asin(y))


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Columns are what q v q* makes of the three axes (Hamilton's product, written out)."""
    w, *vector = quaternion / np.linalg.norm(quaternion)
    u = np.array(vector)
    columns = [v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)]
    return np.stack(columns, axis=1)


def quaternion_of(matrix: np.ndarray) -> np.ndarray:
    """The eigenvector of Bar-Itzhack's symmetric matrix: (w, x, y, z) with w >= 0."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[1, 0] + m[0, 1], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[2, 0] + m[0, 2], m[2, 1] + m[1, 2], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], np.trace(m)],
        ]
    )
    x, y, z, w = np.linalg.eigh(k, UPLO="L")[1][:, -1]
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)


def kitti_object_rotation(yaw: float) -> np.ndarray:
    """Object (x front, y left, z up) of a label with this `rotation_y`."""
    return turn(0, math.pi / 2) @ turn(2, -yaw)


def sigmoid(value: float) -> float:
    return 1 / (1 + math.exp(-value))


def decode(
    levels: Sequence[dict[str, np.ndarray]], strides, intrinsics, canonical, least=0.05, most=1000
) -> list[dict]:
    """Every cell and class of one photo in turn; arrays are (channels, rows, columns), the class running fastest."""
    fx, fy, cx, cy = map(float, intrinsics)
    num_classes = len(canonical)
    found = []
    for level, (raw, stride) in enumerate(zip(levels, strides, strict=True)):
        of_level = []
        rows, columns = raw["logits"].shape[1:]
        for row in range(rows):
            for column in range(columns):
                for kind in range(num_classes):
                    value = {name: array[:, row, column].astype(np.float64) for name, array in raw.items()}
                    own = {
                        name: [value[name][c * num_classes + kind] for c in range(len(value[name]) // num_classes)]
                        for name in ("quaternion", "center", "depth", "size", "confidence")
                    }
                    p = sigmoid(value["logits"][kind]) * sigmoid(value["centerness"][0])
                    if p <= least:
                        continue
                    x, y = column * stride, row * stride
                    left, top, right, bottom = value["box2d"]
                    u, v = x + own["center"][0], y + own["center"][1]
                    z = own["depth"][0] / (500 * math.hypot(1 / fx, 1 / fy))
                    ray = np.array([(u - cx) / fx, (v - cy) / fy, 1.0])
                    of_level.append(
                        {
                            "p": p,
                            "level": level,
                            "cell": row * columns + column,
                            "kind": kind,
                            "box2d": [x - left, y - top, x + right, y + bottom],
                            "score_2d": math.sqrt(p),
                            "score_3d": math.sqrt(p) * sigmoid(own["confidence"][0]),
                            "rotation": pointed_at(ray) @ matrix_of(np.array(own["quaternion"])),
                            "projected_center": [u, v],
                            "center": ray * min(max(z, 0.1), 80.0),
                            "size": [(math.tanh(s) + 1) * c for s, c in zip(own["size"], canonical[kind], strict=True)],
                        }
                    )
        best = sorted(range(len(of_level)), key=lambda i: -of_level[i]["p"])[:most]
        found += [of_level[i] for i in sorted(best)]
    return found


def box_iou(a: Sequence[float], b: Sequence[float]) -> float:
    """Of boxes x0, y0, x1, y1."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    common = max(width, 0.0) * max(height, 0.0)
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common
    return common / union if union > 0 else 0.0


def suppress(kinds: Sequence[int], iou: Sequence[Sequence[float]], most_iou: float) -> list[int]:
    """One box after the other, best first: it stays unless one of its class that stays overlaps it too much."""
    kept: list[int] = []
    for i in range(len(kinds)):
        if all(kinds[i] != kinds[j] or iou[i][j] <= most_iou for j in kept):
            kept.append(i)
    return kept


def clip(polygon: list[Point], window: list[Point]) -> list[Point]:
    """Sutherland and Hodgman: what of a polygon lies in a convex window whose corners go around counter-clockwise."""
    for (ax, ay), (bx, by) in zip(window, window[1:] + window[:1], strict=True):
        side = [(bx - ax) * (y - ay) - (by - ay) * (x - ax) for x, y in polygon]
        result: list[Point] = []
        for i, (x, y) in enumerate(polygon):
            (px, py), before = polygon[i - 1], side[i - 1]
            if (before < 0) != (side[i] < 0):
                t = before / (before - side[i])
                result.append((px + t * (x - px), py + t * (y - py)))
            if side[i] >= 0:
                result.append((x, y))
        polygon = result
    return polygon


def polygon_area(polygon: list[Point]) -> float:
    """Positive where the corners go around counter-clockwise."""
    pairs = zip(polygon, polygon[1:] + polygon[:1], strict=True)
    return sum(ax * by - ay * bx for (ax, ay), (bx, by) in pairs) / 2


def polygon_iou(a: list[Point], b: list[Point]) -> float:
    """Of convex polygons, whichever way around."""
    a, b = (polygon if polygon_area(polygon) > 0 else polygon[::-1] for polygon in (a, b))
    common = polygon_area(clip(a, b))
    return common / (polygon_area(a) + polygon_area(b) - common)
