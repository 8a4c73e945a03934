"""Photo-like pictures by Mitsuba 3 (extra `photo`): the same car, street, sun and camera as the ray caster's, path traced.

Only colour comes from here; mask, depth, box and camera stay those of the exact rays. Mitsuba draws the car and the
ground near it; further away the pixel is the street's own radiance, as in `background`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from carstudio.errors import InputError
from carstudio.synthetic.background import radiance
from carstudio.synthetic.cameras import Viewpoint
from carstudio.synthetic.mitsuba_scene import build_scene
from carstudio.synthetic.shading import Scene

INSTALL_HINT = "pip install 'carstudio[photo]', or ./run setup photo"
# Compiled for one ray at a time. The variants that compile at run time are up to twice as quick, yet they end the whole
# process where they meet an LLVM they do not like, and their noise is another one: photos would depend on the machine.
VARIANT = "scalar_rgb"
SAMPLES = 64
PASSES = 4  # the samples are taken in so many pictures
FIREFLY = 2.0  # a pass counts at most this many times the passes' median (and a little): no single bright dots


def load_mitsuba() -> Any:
    """The module with its variant set, on as many threads as torch takes; `InputError` where it is not installed."""
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise InputError(f"--renderer mitsuba needs Mitsuba 3, which is not installed ({error}): {INSTALL_HINT}") from error
    mitsuba.set_variant(VARIANT)
    drjit.set_thread_count(torch.get_num_threads())
    return mitsuba


def path_tracer(scene: Scene) -> Callable[[Viewpoint, int], Float[np.ndarray, "height width 3"]]:
    """Radiance of pictures of a scene, by viewpoint and seed; the same seed gives the same picture."""
    mi = load_mitsuba()
    built = build_scene(mi, scene)

    def render(viewpoint: Viewpoint, seed: int) -> Float[np.ndarray, "height width 3"]:
        sensor = mi.load_dict(sensor_of(mi, viewpoint))
        passes = np.stack([
            np.array(mi.render(built, sensor=sensor, spp=SAMPLES // PASSES, seed=seed * PASSES + number))
            for number in range(PASSES)
        ])
        limit = FIREFLY * np.median(passes, axis=0) + 0.2
        picture = np.minimum(passes, limit).mean(axis=0)
        return picture[..., :3] + (1 - picture[..., 3:]) * beyond(scene, viewpoint)

    return render


def beyond(scene: Scene, viewpoint: Viewpoint) -> Float[np.ndarray, "height width 3"]:
    """The street behind car and ground plane: the mean of 2 x 2 rays to a pixel."""
    size = viewpoint.camera.width
    v, u, b, a = np.meshgrid(np.arange(size), np.arange(size), (0.25, 0.75), (0.25, 0.75), indexing="ij")
    origins, directions = viewpoint.rays(np.stack([u + a, v + b], axis=-1).reshape(-1, 2))
    directions = (directions / np.linalg.norm(directions, axis=-1, keepdims=True)).astype(np.float32)
    rgb = radiance(scene.street, scene.light, origins.astype(np.float32), directions, scene.baked.ground_light)
    return rgb.reshape(size, size, 4, 3).mean(axis=2)


def sensor_of(mi: Any, viewpoint: Viewpoint) -> dict[str, Any]:
    """Our pinhole camera as Mitsuba's: x left and y up in its frame, the principal point as an offset in widths."""
    size = viewpoint.camera.width
    fx, fy, cx, cy = viewpoint.camera.intrinsics.double().tolist()
    assert abs(fx - fy) < 1e-4 * fx, "Mitsuba's pixels are square"
    car_from_sensor = np.eye(4)
    car_from_sensor[:3, :3] = viewpoint.rotation.T @ np.diag([-1.0, -1.0, 1.0])
    car_from_sensor[:3, 3] = -viewpoint.rotation.T @ viewpoint.translation
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(size / 2 / fx))),
        "fov_axis": "x",
        "near_clip": 0.05,
        "far_clip": 500.0,
        "to_world": mi.ScalarTransform4f(car_from_sensor),
        "principal_point_offset_x": (size / 2 - cx) / size,
        "principal_point_offset_y": (size / 2 - cy) / size,
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},  # a pixel is the mean over its own square
        },
        "sampler": {"type": "multijitter", "sample_count": SAMPLES // PASSES},
    }
