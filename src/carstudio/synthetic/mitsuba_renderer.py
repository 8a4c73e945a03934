"""Photo-like pictures by Mitsuba 3 (extra `photo`): the ray caster's car, street, light and camera, path traced.

Only colour comes from here; mask, depth, box and camera stay those of the exact rays. Mitsuba draws the car and the
ground near it; further away a pixel is the street's own radiance, as in `background`.
"""

import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import torch

from carstudio.errors import InputError
from carstudio.synthetic.background import radiance
from carstudio.synthetic.cameras import Viewpoint
from carstudio.synthetic.mitsuba_scene import build_scene
from carstudio.synthetic.photographs import SUBPIXELS, Radiance, Render, unit_rays
from carstudio.synthetic.shading import Scene

INSTALL_HINT = "pip install 'carstudio[photo]', or ./run setup photo"
QUICK, SURE = "llvm_ad_rgb", "scalar_rgb"  # compiles at run time with LLVM, 2 to 4 times as quick; needs nothing
PROBE_SECONDS = 120.0  # a cold start with compilation takes about 5
SAMPLES = 64  # to a pixel: noise of about 2 % on the car, a camera's own
PASSES = 4  # the samples are taken in so many pictures
FIREFLY = 2.0  # of which none counts more than this many times their median (and a little): no single bright dots


@dataclass(frozen=True)
class PathTracer:
    """Mitsuba in one of its variants, whose noise differs."""

    variant: str

    @property
    def name(self) -> str:
        """The program's version, variant and samples: with the seed they decide every pixel."""
        return f"mitsuba {version('mitsuba')} {self.variant} {SAMPLES} samples"

    def prepare(self, scene: Scene) -> Render:
        """Meshes, materials, ground and sky; the same seed gives the same picture, on any number of threads."""
        mi = load_mitsuba(self.variant)
        built = build_scene(mi, scene)

        def render(viewpoint: Viewpoint, seed: int) -> Radiance:
            sensor = mi.load_dict(sensor_of(mi, viewpoint))
            seeds = range(seed * PASSES, (seed + 1) * PASSES)
            passes = [np.array(mi.render(built, sensor=sensor, spp=SAMPLES // PASSES, seed=one)) for one in seeds]
            rgba = without_fireflies(np.stack(passes))
            return rgba[..., :3] + (1 - rgba[..., 3:]) * beyond(scene, viewpoint)

        return render


def pick_path_tracer() -> PathTracer:
    """The quick variant where a trial run of it succeeds, else the sure one; `InputError` where Mitsuba is missing."""
    load_mitsuba(SURE)
    return PathTracer(QUICK if is_usable(QUICK) else SURE)


def is_usable(variant: str) -> bool:
    """Whether a small picture can be made, tried in a process of its own: a wrong LLVM ends the whole process."""
    command = [sys.executable, "-m", "carstudio.synthetic.mitsuba_probe", variant]
    try:
        ended = subprocess.run(command, capture_output=True, timeout=PROBE_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return ended.returncode == 0


def load_mitsuba(variant: str) -> Any:
    """The module with its variant set, on as many threads as torch takes; `InputError` where it is not installed."""
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise InputError(
            f"--renderer mitsuba needs Mitsuba 3, which cannot be imported ({error}): {INSTALL_HINT}"
        ) from error
    mitsuba.set_variant(variant)
    drjit.set_thread_count(torch.get_num_threads())
    return mitsuba


def without_fireflies(passes: np.ndarray) -> np.ndarray:
    """Mean of pictures of the same thing, less what only one of them saw: chance finds of the sun in a mirror."""
    return np.minimum(passes, FIREFLY * np.median(passes, axis=0) + 0.05).mean(axis=0)


def beyond(scene: Scene, viewpoint: Viewpoint) -> Radiance:
    """The street behind the car and the near ground, by the ray caster's rays."""
    size, per_pixel = viewpoint.camera.width, len(SUBPIXELS) ** 2
    rgb = radiance(scene.street, scene.light, *unit_rays(viewpoint), scene.baked.ground_light)
    return rgb.reshape(size, size, per_pixel, 3).mean(axis=2)


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
