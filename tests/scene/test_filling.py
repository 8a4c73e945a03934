"""Filling holes: colours are taken where pixels are, surfaces do not run into each other, nothing else changes."""

import numpy as np

from carstudio.scene.filling import fill_hole, sampled_colours
from scene.toy_log import toy_scene


def test_colours_are_sampled_at_pixel_centres():
    photo = np.random.default_rng(0).integers(0, 255, (40, 50, 3), np.uint8)
    rows, columns = np.array([3, 20, 38]), np.array([5, 30, 48])
    centres = np.stack([columns + 0.5, rows + 0.5], axis=1).astype(np.float64)
    np.testing.assert_array_equal(sampled_colours(photo, centres), photo[rows, columns])
    between = sampled_colours(photo, centres + np.array([0.5, 0.0]))
    mean = (photo[rows, columns].astype(float) + photo[rows, columns + 1]) / 2
    np.testing.assert_allclose(between, mean, atol=1.0)


def test_walls_do_not_run_into_the_road(tmp_path):
    """Bright wall above, dark road below, the hole across both: each is continued by its own kind."""
    frame = toy_scene(tmp_path, frames=1, tracks={}).frames[0]
    photo = np.full((96, 160, 3), 220, np.uint8)
    photo[48:] = 40
    hole = np.zeros((96, 160), bool)
    hole[20:80, 40:120] = True
    road = np.zeros((96, 160), bool)
    road[48:] = True
    filled = fill_hole(
        np.where(hole[..., None], 128, photo).astype(np.uint8),
        hole,
        avoid=np.zeros_like(hole),
        on_ground=road,
        depth_m=np.full((96, 160), 10.0),
        frame=frame,
        neighbours=(),
        read=lambda frame: photo,
    )
    np.testing.assert_allclose(filled.image, photo, atol=8)  # Telea extrapolates gradients, of rounding too
    np.testing.assert_array_equal(filled.image[~hole], photo[~hole])
    assert not filled.is_seen.any()
