"""How high the ground is: by what stands on it, and by the camera's way.

Labelled boxes stand on the ground, and where poses are known the camera went at a known height above it. Around a place
a plane is fitted to the nearest of these, held level where there are few.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from carstudio.scene.graph import Scene, SceneFrame
from carstudio.scene.places import posed_frames, standing, world_from_camera

CAMERA_HEIGHT_M = 1.65  # KITTI's cameras above the road (its set-up page)
_NEAR_M = 8.0  # samples farther off count less
_LEVEL_WEIGHT = 0.05  # of the belief in level ground at the camera's height, against one sample right here
_TILT_WEIGHT = 20.0  # m^2: how far samples must spread before a slope is believed


@dataclass(frozen=True)
class Terrain:
    """Points of the ground: in the world where the log has poses, else by frame in its camera's frame."""

    world: Float[np.ndarray, "n 3"]
    by_frame: dict[int, Float[np.ndarray, "_ 3"]]

    def height(self, frame: SceneFrame, x: float, z: float) -> float:
        """How low (camera y, down, m) the ground is at (x, z) of a frame's camera."""
        points = self._points(frame)
        near = np.exp(-(((points[:, 0] - x) ** 2 + (points[:, 2] - z) ** 2) / _NEAR_M**2)) + 1e-6
        usual = CAMERA_HEIGHT_M
        offsets = np.stack([np.ones(len(points)), points[:, 0] - x, points[:, 2] - z], axis=1)
        belief = np.diag([_LEVEL_WEIGHT, _TILT_WEIGHT, _TILT_WEIGHT])
        for _ in range(3):  # samples that stand out (a box on a kerb, a bad label) lose their say
            normal = (offsets * near[:, None]).T @ offsets + belief
            right = (offsets * near[:, None]).T @ points[:, 1] + np.array([_LEVEL_WEIGHT * usual, 0, 0])
            plane = np.linalg.solve(normal, right)
            misses = np.abs(points[:, 1] - offsets @ plane)
            near = near * np.minimum(1.0, 0.2 / np.maximum(misses, 1e-9))
        return float(plane[0])

    def _points(self, frame: SceneFrame) -> Float[np.ndarray, "n 3"]:
        pose = world_from_camera(frame)
        if pose is None or not len(self.world):
            return self.by_frame.get(frame.index, np.zeros((0, 3)))
        return (self.world - pose[:3, 3]) @ pose[:3, :3]


def terrain_of(scene: Scene) -> Terrain:
    """The ground of a scene, from labelled boxes that no edit has touched, and from its poses."""
    by_frame: dict[int, list[np.ndarray]] = {}
    world: list[np.ndarray] = []
    frames = {frame.index: frame for frame in scene.frames}
    for _, track in sorted(scene.tracks.items()):  # sums round by their order, which is not to matter
        for index, box in track.boxes.items():
            if index not in track.labels or track.is_drawn_at(index):
                continue
            bottom, pose = standing(box), world_from_camera(frames[index])
            by_frame.setdefault(index, []).append(bottom)
            if pose is not None:
                world.append(pose[:3, :3] @ bottom + pose[:3, 3])
    world += [pose[:3, 3] + pose[:3, 1] * CAMERA_HEIGHT_M for _, pose in posed_frames(scene)]
    return Terrain(np.array(world).reshape(-1, 3), {index: np.array(points) for index, points in by_frame.items()})
