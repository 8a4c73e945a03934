"""A parametric car from a seed: style, size, paint and every part, as one mesh in the car frame."""

from dataclasses import dataclass

import numpy as np

from carstudio.synthetic.body import body_parts
from carstudio.synthetic.cabin import cabin_parts
from carstudio.synthetic.details import detail_parts
from carstudio.synthetic.materials import Paint, car_materials, draw_paint
from carstudio.synthetic.styles import Style, draw_style
from carstudio.synthetic.surfaces import CarMesh, car_mesh
from carstudio.synthetic.wheels import wheel_parts


@dataclass(frozen=True)
class Car:
    """A mesh with what is known of it. `paint` is None for cars read from files."""

    mesh: CarMesh
    style: str
    paint: Paint | None


def build_car(style: Style, paint: Paint, rng: np.random.Generator) -> Car:
    """The car of a varied style; rims, mirrors and trim are drawn from `rng`."""
    parts = [*body_parts(style), *cabin_parts(style), *wheel_parts(style, rng), *detail_parts(style, rng)]
    return Car(car_mesh(parts, car_materials(paint, rng)), style.name, paint)


def draw_car(rng: np.random.Generator, repaint: Paint | None = None) -> Car:
    """A car drawn from the distributions of styles and paints; the same generator state gives the same car.

    `repaint` takes the place of the drawn paint and changes nothing else.
    """
    style, paint = draw_style(rng), draw_paint(rng)
    return build_car(style, repaint or paint, rng)


def paint_of(rng: np.random.Generator) -> Paint:
    """The paint that `draw_car` gives the car of this generator state; nothing is built."""
    draw_style(rng)
    return draw_paint(rng)
