"""Proves that shape annotations are live while tests run: a wrong shape, rank or type must be refused.

Without the import hook (`--jaxtyping-packages=carstudio,beartype.beartype`) these annotations check nothing, silently.
"""

import jaxtyping
import numpy as np
import pytest
import torch

from carstudio.geometry.box3d import Box3D
from carstudio.geometry.canonical import ray_cube_interval
from carstudio.geometry.transforms import rotation_from_quaternion, transform_points
from carstudio.images import to_uint8


def test_wrong_last_dimension_is_refused():
    with pytest.raises(jaxtyping.TypeCheckError):
        rotation_from_quaternion(torch.zeros(3))


def test_disagreeing_batch_dimensions_are_refused():
    with pytest.raises(jaxtyping.TypeCheckError):
        transform_points(torch.eye(4).expand(2, 4, 4), torch.zeros(3, 5, 3))


def test_disagreeing_ray_counts_are_refused():
    with pytest.raises(jaxtyping.TypeCheckError):
        ray_cube_interval(torch.zeros(4, 3), torch.zeros(5, 3))


def test_wrong_dtype_is_refused():
    with pytest.raises(jaxtyping.TypeCheckError):
        to_uint8(np.zeros((2, 2, 3), dtype=np.int64))


def test_fields_of_a_record_are_checked():
    with pytest.raises(jaxtyping.TypeCheckError):
        Box3D(torch.zeros(2, 3), torch.ones(3, 3), torch.eye(3).expand(2, 3, 3))


def test_right_shapes_pass():
    moved = transform_points(torch.eye(4).expand(2, 4, 4), torch.ones(2, 5, 3))
    assert moved.shape == (2, 5, 3)
