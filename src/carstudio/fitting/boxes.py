"""Boxes that give way within bounds: pose and size as the photographs want them.

A photograph says well where a car's outline lies and how large it looks, hardly how far away the car is: a larger one
farther off looks the same. So the numbers that move are chosen apart from each other: the shift across the line of
sight, the turn, the apparent size, each for a photograph, and the lengths of the sides for a car. When the sides grow
together the car moves away in every photograph and looks the same; where nothing speaks for that, a prior keeps it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.transforms import rotation_from_quaternion


@dataclass(frozen=True)
class BoxFreedom:
    """What of a box may change, and by how much at most."""

    refine_pose: bool = False
    """Refine place and rotation, for each photograph."""
    refine_size: bool = False
    """Refine length, height and width, for each car."""
    most_shift: float = 0.1
    """Across the line of sight, in lengths of the car."""
    most_turn_deg: float = 8.0
    """About each of the car's axes."""
    most_apparent: float = 0.1
    """Change of the apparent size (its logarithm)."""
    most_side: float = 0.1
    """Change of each side (its logarithm)."""
    box_rate: float = 0.03
    """Learning rate (Adam), in shares of these bounds."""
    box_prior: float = 2e-4
    """Loss of a number at its bound: what the photographs do not speak for stays where it was."""

    def __post_init__(self) -> None:
        bounds = (self.most_shift, self.most_apparent, self.most_side)
        if not all(0 <= bound <= 1 for bound in bounds) or not 0 <= self.most_turn_deg <= 45:
            raise InputError("box freedom: bounds must be 0 to 1, turns 0 to 45 degrees")
        if self.box_rate < 0 or self.box_prior < 0:
            raise InputError("box freedom: box_rate and box_prior must be 0 or more")


@dataclass(frozen=True)
class BoxMoves:
    """Shares of the bounds, before tanh: all zero leaves every box as it is."""

    photo: Float[Tensor, "photo 6"]  # shift right, shift down, turn about x, y, z, apparent size
    car: Float[Tensor, "car 3"]  # length, height, width

    @staticmethod
    def none(num_photos: int, num_cars: int, like: Tensor) -> "BoxMoves":
        """No box moves."""
        return BoxMoves(like.new_zeros(num_photos, 6), like.new_zeros(num_cars, 3))


def moved_boxes(box: Box3D, car: Int[Tensor, " photo"], moves: BoxMoves, freedom: BoxFreedom) -> Box3D:
    """The boxes of photographs (rows) after the moves; `car` says whose row of `moves.car` each photograph is of.

    The turn is the one that the camera sees: shifted across the line of sight, a car turns along with it, so that its
    picture moves and stays the same.
    """
    photo, sides = (
        torch.tanh(moves.photo),
        torch.tanh(moves.car)[car] * (freedom.most_side if freedom.refine_size else 0.0),
    )
    if not freedom.refine_pose:
        return Box3D(box.center, box.size * sides.exp(), box.rotation)
    shift, turn, apparent = photo.split([2, 3, 1], dim=-1)
    distance = box.center.norm(dim=-1, keepdim=True)
    sight = box.center / distance
    right, down = across(sight)
    angle = shift * freedom.most_shift * box.size[..., :1] / distance
    aimed = torch.nn.functional.normalize(sight + angle[..., :1] * right + angle[..., 1:] * down, dim=-1)
    far = distance * (sides.mean(dim=-1, keepdim=True) - apparent * freedom.most_apparent).exp()
    half = turn * (math.radians(freedom.most_turn_deg) / 2)
    turned = rotation_from_quaternion(torch.cat([torch.ones_like(half[..., :1]), half], dim=-1))
    return Box3D(aimed * far, box.size * sides.exp(), shortest_rotation(sight, aimed) @ box.rotation @ turned)


def across(sight: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"]]:
    """Unit vectors to the right and down of a line of sight (camera frame), at right angles to it."""
    down = sight.new_tensor([0.0, 1.0, 0.0]).expand_as(sight)
    right = torch.nn.functional.normalize(torch.linalg.cross(down, sight), dim=-1)
    return right, torch.linalg.cross(sight, right)


def shortest_rotation(a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation by the smallest angle that carries unit vector a to b (not its opposite)."""
    real = 1 + (a * b).sum(dim=-1, keepdim=True)
    return rotation_from_quaternion(torch.cat([real, torch.linalg.cross(a, b)], dim=-1))


def prior_of(moves: BoxMoves, freedom: BoxFreedom) -> Float[Tensor, ""]:
    """Loss of the moves: `freedom.box_prior` for each number at its bound, summed, so that cars do not share it."""
    return freedom.box_prior * (torch.tanh(moves.photo).square().sum() + torch.tanh(moves.car).square().sum())
