"""A category model whose cars are radiance fields: it hands `query` to the one volume renderer."""

import torch
from jaxtyping import Float
from torch import Tensor

from carstudio.geometry.box3d import Box3D
from carstudio.models.interface import CategoryModel, Latents
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.field import SamplingConfig, trace_field
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Segments


class FieldModel(CategoryModel):
    """Subclasses give `encode` and `query`."""

    sampling: SamplingConfig

    def query(
        self, gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"], latents: Latents
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density per canonical unit and rgb in [0, 1] at Gaussians of the canonical frame."""
        raise NotImplementedError

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        """Coarse and fine segments of the field between entry to and exit from the box."""

        def field(
            gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"]
        ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
            return self.query(gaussians, view_directions, latents)

        return trace_field(field, rays, to_canonical(rays, box), self.sampling, generator)
