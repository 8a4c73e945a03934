"""`python -m carstudio.synthetic.mitsuba_probe VARIANT`: a small picture with everything our scenes are made of.

Ends with exit code 0 if that variant of Mitsuba works here. With an LLVM it does not like it aborts, which is why this
is a program of its own.
"""

import sys
from typing import Any

import numpy as np

from carstudio.synthetic.mitsuba_renderer import load_mitsuba
from carstudio.synthetic.mitsuba_scene import look


def small_scene(mi: Any) -> Any:
    """A square of paint, half metal, under a masked one and a map of light, seen by a camera of 16 x 16 px."""
    paint = np.tile(np.array([0.5, 0.2, 0.1, 0.05, 0.5, 0.4, 4.0], np.float32), (4, 4, 1))
    masked = {"type": "mask", "opacity": 0.5, "bsdf": look(mi, paint, has_colours=False)}
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    above = mi.ScalarTransform4f().translate([0.0, 0.0, 0.5])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5, "hide_emitters": True},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32))},
            "paint": {"type": "rectangle", "bsdf": look(mi, paint, has_colours=False)},
            "glass": {"type": "rectangle", "to_world": above, "bsdf": masked},
            "camera": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": film,
                "sampler": {"type": "multijitter", "sample_count": 4},
            },
        }
    )


def main(variant: str) -> int:
    """0 if the picture is finite and lit."""
    mi = load_mitsuba(variant)
    picture = np.array(mi.render(small_scene(mi), spp=4))
    return 0 if bool(np.isfinite(picture).all()) and float(picture[..., :3].mean()) > 0.05 else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
