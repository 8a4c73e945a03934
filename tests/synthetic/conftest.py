"""One car and its scene for all tests here."""

import numpy as np
import pytest

from carstudio.synthetic.cars import Car, build_car
from carstudio.synthetic.materials import PAINTS
from carstudio.synthetic.photographs import Photograph, draw_photographs
from carstudio.synthetic.styles import STYLES


@pytest.fixture(scope="session")
def red_car() -> Car:
    paint = next(paint for paint in PAINTS if paint.name == "red")
    return build_car(STYLES["sedan"], paint, np.random.default_rng(1))


@pytest.fixture(scope="session")
def photographs(red_car: Car) -> list[Photograph]:
    return draw_photographs(red_car, seed=(11, 0), num_views=6, size_px=96, cameras="mixed")
