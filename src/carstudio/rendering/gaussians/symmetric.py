"""Many symmetric 3 x 3 matrices, kept as six arrays: products of arrays beat batches of tiny matrices."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

Planes = tuple[Tensor, Tensor, Tensor]
"""x, y and z of many vectors, an array each."""


@dataclass(frozen=True)
class Symmetric3:
    """The upper triangles of symmetric 3 x 3 matrices, an array per entry, all of one shape."""

    xx: Tensor
    xy: Tensor
    xz: Tensor
    yy: Tensor
    yz: Tensor
    zz: Tensor

    @classmethod
    def of_matrix(cls, matrix: Float[Tensor, "*batch 3 3"]) -> "Symmetric3":
        """The upper triangle of each; what lies below it is not looked at."""
        return cls(*(matrix[..., row, column] for row, column in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))))

    def matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """All nine entries."""
        rows = [self.xx, self.xy, self.xz, self.xy, self.yy, self.yz, self.xz, self.yz, self.zz]
        return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))

    def __mul__(self, factor: Tensor | float) -> "Symmetric3":
        entries = (self.xx, self.xy, self.xz, self.yy, self.yz, self.zz)
        return Symmetric3(*(entry * factor for entry in entries))

    def plus_diagonal(self, x: Tensor, y: Tensor, z: Tensor) -> "Symmetric3":
        """M + diag(x, y, z)."""
        return Symmetric3(self.xx + x, self.xy, self.xz, self.yy + y, self.yz, self.zz + z)

    def cofactors(self) -> "Symmetric3":
        """det(M) M^-1."""
        return Symmetric3(
            self.yy * self.zz - self.yz * self.yz,
            self.xz * self.yz - self.xy * self.zz,
            self.xy * self.yz - self.xz * self.yy,
            self.xx * self.zz - self.xz * self.xz,
            self.xy * self.xz - self.xx * self.yz,
            self.xx * self.yy - self.xy * self.xy,
        )

    def inverse(self) -> "Symmetric3":
        """M^-1, of matrices that have one."""
        return self.inverse_by(self.cofactors())

    def inverse_by(self, cofactors: "Symmetric3") -> "Symmetric3":
        """M^-1 from cofactors at hand."""
        determinant = self.xx * cofactors.xx + self.xy * cofactors.xy + self.xz * cofactors.xz
        return cofactors * (1 / determinant)

    def times(self, vector: Planes) -> Planes:
        """M v."""
        x, y, z = vector
        return (
            self.xx * x + self.xy * y + self.xz * z,
            self.xy * x + self.yy * y + self.yz * z,
            self.xz * x + self.yz * y + self.zz * z,
        )

    def quadratic(self, vector: Planes) -> Tensor:
        """v^T M v."""
        return dot(self.times(vector), vector)


def planes(vectors: Float[Tensor, "*batch n"]) -> tuple[Tensor, ...]:
    """The last axis taken apart into arrays that each lie in one piece."""
    return vectors.movedim(-1, 0).contiguous().unbind(0)


def planes3(vectors: Float[Tensor, "*batch 3"]) -> Planes:
    """`planes` of vectors in space."""
    x, y, z = planes(vectors)
    return x, y, z


def dot(first: Planes, second: Planes) -> Tensor:
    """The scalar product of each pair."""
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
