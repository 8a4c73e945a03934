"""A drive past a standing car, as KITTI's tracking sequences show one, and the car turned where it stands.

A drive sees a narrow range of azimuths; the turned views are the truth for all others. Car frame as in `cameras`.
"""

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.cameras import KITTI_CX, KITTI_CY, KITTI_FOCAL_PX, Viewpoint, fit_window, look
from carstudio.synthetic.surfaces import CarMesh

# Of tracks 0-3 of KITTI tracking 0001: 2.9 m to the right or 6.1 m to the left, first seen 7 to 20 m away, cut off by
# the picture's edge from a bearing of some 37 degrees on.
BESIDE_M, FIRST_AHEAD_M, LAST_BEARING_DEG = (2.8, 6.2), (16.0, 22.0), (26.0, 35.0)
_INTRINSICS = np.array([KITTI_FOCAL_PX, KITTI_FOCAL_PX, KITTI_CX, KITTI_CY])


def draw_drive(rng: np.random.Generator, mesh: CarMesh, *, num_frames: int, size_px: int) -> list[Viewpoint]:
    """The frames of a drive in time order, evenly spaced; the car stands along the road, on either side, either way.

    The camera looks ahead, shaken by a degree about the vertical; the window of each frame is the car's, as in
    `draw_viewpoint`.
    """
    heading = np.pi * rng.integers(2) + np.radians(rng.normal(0, 5))
    ahead = np.array([np.cos(heading), 0.0, np.sin(heading)])
    beside = np.array([-np.sin(heading), 0.0, np.cos(heading)]) * rng.choice([-1.0, 1.0]) * rng.uniform(*BESIDE_M)
    first = rng.uniform(*FIRST_AHEAD_M)
    last = float(np.linalg.norm(beside)) / np.tan(np.radians(rng.uniform(*LAST_BEARING_DEG)))
    up = np.array([0, float(mesh.size[1]) / 2 - rng.uniform(1.55, 1.75), 0])
    frames = []
    for distance in np.linspace(first, last, num_frames):
        shaken = np.radians(rng.normal(0, 1))
        forward = np.array([np.cos(heading + shaken), 0.0, np.sin(heading + shaken)])
        rotation = look(forward)
        frames.append(_seen(rng, mesh, rotation, -rotation @ (beside + up - distance * ahead), size_px))
    return frames


def turned_views(
    rng: np.random.Generator, mesh: CarMesh, frame: Viewpoint, *, num_turns: int, size_px: int
) -> list[Viewpoint]:
    """The car of a frame after 1, 2, ... of `num_turns` equal turns to its left about its vertical axis.

    Its place before the camera stays, so that its position is that of the frame; each window is drawn anew.
    """
    views = []
    for angle in np.arange(1, num_turns) * 2 * np.pi / num_turns:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        views.append(_seen(rng, mesh, frame.rotation @ turn, frame.translation, size_px))
    return views


def _seen(
    rng: np.random.Generator,
    mesh: CarMesh,
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    size_px: int,
) -> Viewpoint:
    x, y, z = -rotation.T @ translation
    azimuth, elevation = float(np.arctan2(z, x)) % (2 * np.pi), float(np.arctan2(-y, np.hypot(x, z)))
    camera = fit_window(rng, mesh, _INTRINSICS, rotation, translation, size_px)
    return Viewpoint(camera, rotation, translation, azimuth, elevation, "kitti")
