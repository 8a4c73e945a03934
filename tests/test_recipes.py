"""Recipes and what `supervised` makes of them."""

import dataclasses

import pytest

from carstudio.errors import InputError
from carstudio.recipes import RECIPES, recipe, supervised


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_bears_its_name(name: str) -> None:
    assert recipe(name).recipe == name


def test_an_unknown_recipe_names_those_there_are() -> None:
    with pytest.raises(InputError, match="car-gaussians"):
        recipe("car-gauss")


def test_a_model_of_two_sides_sees_the_mirror_where_no_other_photo_shows_the_other_side() -> None:
    gaussians = recipe("car-gaussians")
    assert gaussians.mirroring == recipe("car-gaussians-preview").mirroring == "apart-where-alone"
    assert supervised(gaussians, "single-view").mirroring == "apart"
    assert supervised(gaussians, "multi-view") == dataclasses.replace(gaussians, supervision="multi-view")
    assert supervised(dataclasses.replace(gaussians, mirroring="off"), "single-view").mirroring == "off"
    nerf = recipe("car-nerf")
    assert supervised(nerf, "single-view") == nerf  # the paper's
