"""Body styles: how large cars of a style are, and where along the car its lines run.

Sizes are the manufacturers' (body without mirrors, metres), as mean and standard deviation over best-selling European
models of the years 2005-2020 read from public data sheets; KITTI's "Car" boxes (mean 3.88 x 1.53 x 1.63 m, early
2010s, tight) lie between our hatchback and sedan. Positions along the car are shares of the length from the front
bumper (0) to the rear one (1), heights shares of the total height; read off side-view drawings of typical models.
"""

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

StyleName = Literal["hatchback", "sedan", "suv", "estate", "van", "coupe", "pickup"]
STYLE_NAMES: tuple[StyleName, ...] = get_args(StyleName)


@dataclass(frozen=True, kw_only=True)
class Style:
    """Means of one body style; `vary` draws a car around them."""

    name: StyleName
    share: float
    """Share among the cars drawn: European new registrations by body style 2010-2020, coupe and pickup raised so that
    a few hundred cars hold some of each."""
    size: tuple[float, float, float]
    """Length, height, width, m."""
    size_std: tuple[float, float, float]
    """Standard deviations of the same, m."""
    wheel_radius: float
    """m, tyre included."""
    front_axle: float
    rear_axle: float
    clearance: float
    """Height of the sill's lower edge, m."""
    nose_height: float
    cowl_height: float
    belt_height: float
    """Lower edge of the side windows at the car's middle."""
    tail_height: float
    """Upper edge of the body at the rear (boot lid, bed)."""
    cowl: float
    """Foot of the windscreen."""
    header: float
    """Upper edge of the windscreen."""
    roof_end: float
    backlight: float
    """Foot of the rear window."""
    tumblehome: float
    """How much each side window leans inwards, m."""
    roof_drop: float
    """How much the roof falls towards the rear, m."""
    pillars: tuple[float, ...]
    """Positions of the dark pillars between the side windows."""
    glass_end: float
    """Rear end of the last side window."""
    doors: tuple[float, ...]
    """Positions of the door gaps, front to rear."""
    cladding: bool = False
    """Black plastic around sills and arches."""
    bed: bool = False
    """Open load bed behind the cabin."""
    corner: float = 4.0
    """Exponent of the super-ellipse of the plan view: 2 is an ellipse, large values are boxes."""

    has_chrome_grille: bool = True
    grille_width: float = 0.46
    """Half width of the grille as a share of the car's half width."""
    lamp_scale: float = 1.0
    """Size of the head-lamps relative to the usual."""

    def vary(self, rng: np.random.Generator) -> "Style":
        """One car's own numbers: sizes by their deviations (cut at 2), positions by about 1 % of the length."""
        z = np.clip(rng.standard_normal(3), -2, 2)
        length, height, width = (m + s * d for m, s, d in zip(self.size, self.size_std, z, strict=True))
        shift = 0.012 * np.clip(rng.standard_normal(6), -2, 2)
        tall = 0.015 * np.clip(rng.standard_normal(4), -2, 2)
        return replace(
            self,
            size=(float(length), float(height), float(width)),
            wheel_radius=self.wheel_radius * float(rng.uniform(0.96, 1.06)),
            clearance=self.clearance * float(rng.uniform(0.9, 1.1)),
            cowl=self.cowl + float(shift[0]),
            header=self.header + float(shift[0] + 0.7 * shift[1]),
            roof_end=self.roof_end + min(float(shift[2]), 0.01),
            backlight=self.backlight + min(float(0.5 * shift[2]), 0.005),
            nose_height=self.nose_height + float(tall[0]),
            belt_height=self.belt_height + float(tall[1]),
            cowl_height=self.cowl_height + float(0.5 * tall[0] + 0.5 * tall[1]),
            tail_height=self.tail_height + float(tall[1]),
            has_chrome_grille=bool(rng.random() < 0.5),
            grille_width=float(rng.uniform(0.32, 0.50)),
            lamp_scale=float(rng.uniform(0.75, 1.2)),
            corner=self.corner * float(rng.uniform(0.88, 1.15)),
        )


STYLES: dict[StyleName, Style] = {
    style.name: style
    for style in (
        Style(
            name="hatchback", share=0.28, size=(4.05, 1.49, 1.76), size_std=(0.22, 0.04, 0.05), wheel_radius=0.315,
            front_axle=0.20, rear_axle=0.83, clearance=0.17, nose_height=0.50, cowl_height=0.655, belt_height=0.635,
            tail_height=0.68, cowl=0.235, header=0.405, roof_end=0.89, backlight=0.972, tumblehome=0.17, roof_drop=0.06,
            pillars=(0.555,), glass_end=0.845, doors=(0.27, 0.555, 0.775), corner=3.9,
        ),
        Style(
            name="sedan", share=0.20, size=(4.70, 1.45, 1.82), size_std=(0.18, 0.03, 0.04), wheel_radius=0.325,
            front_axle=0.19, rear_axle=0.78, clearance=0.16, nose_height=0.49, cowl_height=0.645, belt_height=0.625,
            tail_height=0.705, cowl=0.275, header=0.43, roof_end=0.69, backlight=0.855, tumblehome=0.19, roof_drop=0.04,
            pillars=(0.53,), glass_end=0.745, doors=(0.295, 0.53, 0.735), corner=4.2,
        ),
        Style(
            name="suv", share=0.20, size=(4.50, 1.68, 1.86), size_std=(0.20, 0.06, 0.05), wheel_radius=0.365,
            front_axle=0.195, rear_axle=0.80, clearance=0.22, nose_height=0.545, cowl_height=0.645, belt_height=0.63,
            tail_height=0.66, cowl=0.255, header=0.40, roof_end=0.90, backlight=0.972, tumblehome=0.17, roof_drop=0.05,
            pillars=(0.53, 0.745), glass_end=0.885, doors=(0.28, 0.53, 0.745), cladding=True, corner=4.4,
        ),
        Style(
            name="estate", share=0.13, size=(4.72, 1.48, 1.82), size_std=(0.16, 0.03, 0.04), wheel_radius=0.325,
            front_axle=0.19, rear_axle=0.775, clearance=0.165, nose_height=0.485, cowl_height=0.64, belt_height=0.62,
            tail_height=0.655, cowl=0.265, header=0.415, roof_end=0.89, backlight=0.975, tumblehome=0.18,
            roof_drop=0.05, pillars=(0.52, 0.725), glass_end=0.895, doors=(0.285, 0.52, 0.725), corner=4.2,
        ),
        Style(
            name="van", share=0.07, size=(4.95, 1.94, 1.93), size_std=(0.22, 0.06, 0.04), wheel_radius=0.34,
            front_axle=0.185, rear_axle=0.79, clearance=0.19, nose_height=0.475, cowl_height=0.575, belt_height=0.575,
            tail_height=0.59, cowl=0.14, header=0.285, roof_end=0.962, backlight=0.985, tumblehome=0.13,
            roof_drop=0.02, pillars=(0.43, 0.68), glass_end=0.935, doors=(0.20, 0.43, 0.68), corner=5.2,
        ),
        Style(
            name="coupe", share=0.06, size=(4.45, 1.33, 1.84), size_std=(0.15, 0.04, 0.04), wheel_radius=0.335,
            front_axle=0.19, rear_axle=0.775, clearance=0.14, nose_height=0.50, cowl_height=0.66, belt_height=0.65,
            tail_height=0.72, cowl=0.315, header=0.475, roof_end=0.64, backlight=0.895, tumblehome=0.22,
            roof_drop=0.03, pillars=(0.615,), glass_end=0.73, doors=(0.33, 0.615), corner=3.7,
        ),
        Style(
            name="pickup", share=0.06, size=(5.30, 1.80, 1.87), size_std=(0.10, 0.04, 0.04), wheel_radius=0.38,
            front_axle=0.175, rear_axle=0.775, clearance=0.27, nose_height=0.575, cowl_height=0.66, belt_height=0.645,
            tail_height=0.655, cowl=0.235, header=0.355, roof_end=0.575, backlight=0.612, tumblehome=0.17,
            roof_drop=0.03, pillars=(0.44,), glass_end=0.575, doors=(0.255, 0.44, 0.60), cladding=True, bed=True,
            corner=5.0,
        ),
    )
}  # fmt: skip


def draw_style(rng: np.random.Generator) -> Style:
    """A style by its share, varied."""
    shares = np.array([STYLES[name].share for name in STYLE_NAMES])
    name = STYLE_NAMES[int(rng.choice(len(STYLE_NAMES), p=shares / shares.sum()))]
    return STYLES[name].vary(rng)
