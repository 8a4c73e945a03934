"""NSG's object model (Ost et al. 2021), for comparing: no prior, trained on the very cars that it shows.

One field for a class, told apart by a code per car that is learned with it. The box is enlarged, few samples are spread
evenly over it, and the colour is told where the object stands: the knobs of the original; the fair variant of the
recipes takes more samples and hides the place.
"""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn

from carstudio.geometry.box3d import Box3D
from carstudio.models.code_nerf import codes_of, encode_points, new_codes
from carstudio.models.field_model import FieldModel
from carstudio.models.interface import Latents, PatchBatch
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.field import SamplingConfig, trace_field
from carstudio.rendering.rays import Rays, to_canonical
from carstudio.rendering.volume import Segments

FAR_M = 50.0  # places are told in this unit


@dataclass(frozen=True)
class NSGConfig:
    """Sizes; the defaults are NSG's own for cars."""

    sampling: SamplingConfig = field(default_factory=lambda: SamplingConfig(coarse=7, fine=0))
    """Samples along a ray: few, evenly spread over the box."""
    code_size: int = 256
    """Length of a car's code."""
    width: int = 256
    """Width of the field."""
    depth: int = 8
    """Layers of the trunk; code and position enter again in the middle."""
    position_frequencies: int = 10
    """Octaves of the position's encoding."""
    direction_frequencies: int = 4
    """Octaves of the direction's and the place's encoding."""
    growth: float = 1.9
    """How much longer and wider than the car its box is taken."""
    sees_place: bool = True
    """Whether the colour is told where the car stands (here: its centre in the camera's frame)."""
    cars: tuple[str, ...] = ()
    """Instance ids that have a code; the trainer fills them in from its data."""


class NSG(FieldModel):
    """Codes and field."""

    encoder_side_px = 8  # photos are not looked at

    def __init__(self, config: NSGConfig) -> None:
        super().__init__()
        self.config = config
        self.sampling = config.sampling
        self.codes = new_codes(config.cars, config.code_size)
        self.field = NSGField(config)

    def code_parameters(self) -> tuple[nn.Parameter, ...]:
        """The codes of all cars."""
        return (self.codes,)

    def encode(self, patches: PatchBatch) -> Latents:
        """Each car's code as its shape, nothing as its texture; the mean code for a car that has none."""
        shape = codes_of(self.codes, self.config.cars, patches.instance_ids)
        return Latents(shape, shape[:, :0])

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        """Segments between entry to and exit from the enlarged box."""
        growth = box.size.new_tensor([self.config.growth, 1.0, self.config.growth])
        enlarged = Box3D(box.center, box.size * growth, box.rotation)

        def query(
            gaussians: Gaussians, view_directions: Float[Tensor, "batch ray 3"]
        ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
            return self.field(gaussians.mean, view_directions, latents.shape, box.center / FAR_M)

        return trace_field(query, rays, to_canonical(rays, enlarged), self.sampling, generator)


class NSGField(nn.Module):
    """NeRF's field with a car's code beside the position, and the car's place beside the direction."""

    def __init__(self, config: NSGConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        entry = 3 + 6 * config.position_frequencies + config.code_size
        seen = 3 + 6 * config.direction_frequencies
        self.middle = config.depth // 2
        sizes = [entry] + [width + (entry if number == self.middle else 0) for number in range(1, config.depth)]
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.density = nn.Linear(width, 1)
        self.bottleneck = nn.Linear(width, width)
        self.colour_hidden = nn.Linear(width + seen * (2 if config.sees_place else 1), width // 2)
        self.colour_out = nn.Linear(width // 2, 3)

    def forward(
        self,
        points: Float[Tensor, "batch ray sample 3"],
        view_directions: Float[Tensor, "batch ray 3"],
        codes: Float[Tensor, "batch code"],
        places: Float[Tensor, "batch 3"],
    ) -> tuple[Float[Tensor, "batch ray sample"], Float[Tensor, "batch ray sample 3"]]:
        """Density per canonical unit of the enlarged box (softplus) and colour (sigmoid)."""
        shape = points.shape[:3]
        code = codes[:, None, None].expand(*shape, -1)
        entry = torch.cat([encode_points(points, self.config.position_frequencies), code], dim=-1)
        hidden = entry
        for number, layer in enumerate(self.trunk):
            if number == self.middle:
                hidden = torch.cat([hidden, entry], dim=-1)
            hidden = torch.relu(layer(hidden))
        density = nn.functional.softplus(self.density(hidden).squeeze(-1).float())
        octaves = self.config.direction_frequencies
        seen = [encode_points(view_directions, octaves)[:, :, None].expand(*shape, -1)]
        if self.config.sees_place:
            seen.append(encode_points(places, octaves)[:, None, None].expand(*shape, -1))
        hidden = torch.relu(self.colour_hidden(torch.cat([self.bottleneck(hidden), *seen], dim=-1)))
        return density, torch.sigmoid(self.colour_out(hidden).float())
