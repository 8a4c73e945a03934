"""How much each row of a table may spend, and at which size: the same for all rows.

`smoke` and `cpu` shrink every radiance field alike (`FieldSize`), so that rows differ by their model alone; `gpu` and
`paper` leave each model at the size of its own paper.
"""

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from carstudio.models.encoders import SMALL_PYRAMID_FEATURES, EncoderConfig
from carstudio.rendering.field import SamplingConfig
from carstudio.training.config import TrainConfig
from carstudio.training.schedule import ScheduleConfig

BudgetName = Literal["smoke", "cpu", "gpu", "paper"]


@dataclass(frozen=True, kw_only=True)
class FieldSize:
    """What small fields have in common."""

    encoder_side_px: int
    width: int
    code_size: int
    samples: int
    patches_per_step: int
    rays_per_patch: int

    def __str__(self) -> str:
        return (
            f"photos encoded at {self.encoder_side_px} px, fields {self.width} wide and half as deep as in "
            f"their papers, codes of {self.code_size}, {self.samples} samples a ray, "
            f"{self.patches_per_step} cars x {self.rays_per_patch} rays a step"
        )


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """What fitting a car at test time and looking at it may take (`table ttopt`)."""

    marks: tuple[int, ...] = (0, 5, 10, 20, 50, 100, 200, 500, 1000)
    """Steps after which views are scored."""
    rays_per_car: int | None = None
    """Rays of a step for each car, shared out evenly among its photos; None: 256 of each photo."""
    scored_views: int | None = None
    """Held-out views of each car that are scored; None: all."""
    fitted_views: int = 2
    """Fitted views of each car that are scored beside them."""

    def __str__(self) -> str:
        rays = "256 rays of each photo" if self.rays_per_car is None else f"some {self.rays_per_car} rays of each car"
        scored = "all" if self.scored_views is None else f"at most {self.scored_views}"
        return f"{self.marks[-1]:,} steps of {rays}; scored: {scored} held-out views and {self.fitted_views} fitted"

    def rays_per_photo(self, num_photos: int, num_cars: int) -> int:
        """Rays of each photo in a step: the same for all photos of a run, whatever car they are of."""
        return 256 if self.rays_per_car is None else max(8, round(self.rays_per_car * num_cars / num_photos))


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Length of each row's training, size of the fields (None: each paper's), and how many images are scored."""

    name: BudgetName
    steps: int | None = None
    cpu_seconds: float | None = None
    size: FieldSize | None = None
    scored: int | None = None
    fitting: Fitting = field(default_factory=Fitting)

    def __str__(self) -> str:
        length = f"{self.steps:,} steps" if self.cpu_seconds is None else f"{self.cpu_seconds:,.0f} CPU-seconds"
        size = "each model at the size of its own paper, 3 cars x 1,024 rays a step" if self.size is None else self.size
        return f"{self.name}: {length} of training per row; {size}"


BUDGETS: dict[BudgetName, Budget] = {
    "smoke": Budget(
        name="smoke",
        steps=20,
        size=FieldSize(encoder_side_px=32, width=32, code_size=32, samples=8, patches_per_step=4, rays_per_patch=64),
        scored=4,
        fitting=Fitting(marks=(0, 2, 6), rays_per_car=128, scored_views=2, fitted_views=2),
    ),
    "cpu": Budget(
        name="cpu",
        cpu_seconds=300.0,
        size=FieldSize(
            encoder_side_px=64, width=128, code_size=128, samples=20, patches_per_step=16, rays_per_patch=48
        ),
        scored=100,
        fitting=Fitting(marks=(0, 10, 20, 50, 100, 200), rays_per_car=384, scored_views=4, fitted_views=1),
    ),
    "gpu": Budget(name="gpu", steps=20_000, scored=400),
    "paper": Budget(name="paper", steps=500_000),
}


def within(budget: Budget, config: TrainConfig) -> TrainConfig:
    """A recipe at the budget's length and size; models that are no radiance fields (`car-gaussians`) keep theirs."""
    if budget.cpu_seconds is not None:
        config = replace(config, cpu_seconds=budget.cpu_seconds, save_every=200)
    elif budget.steps is not None:
        config = replace(config, steps=budget.steps, save_every=min(config.save_every, max(budget.steps, 1)))
    return config if budget.size is None else _shrunk(config, budget)


def _shrunk(config: TrainConfig, budget: Budget) -> TrainConfig:
    size = budget.size
    assert size is not None
    fields = {one.name for one in dataclasses.fields(config.model)}
    if "sampling" not in fields:  # no radiance field: its own size, which is small already
        return config if budget.name != "smoke" else replace(config, patches_per_step=size.patches_per_step)
    own: Any = config.model
    changes: dict[str, Any] = {
        "encoder": EncoderConfig(
            kind="small-pyramid",
            side_px=size.encoder_side_px,
            pretrained=None,
            num_features=SMALL_PYRAMID_FEATURES,
        ),
        "sampling": SamplingConfig(coarse=min(size.samples, own.sampling.coarse), fine=0),
        "width": size.width,
        "depth": (getattr(config.model, "depth", 0) + 1) // 2,
        "skip_after": None,
        "code_size": size.code_size,
    }
    model: Any = replace(config.model, **{name: value for name, value in changes.items() if name in fields})
    return replace(
        config,
        model=model,
        schedule=ScheduleConfig(first=2e-3, last=1e-4, decay_steps=None, warmup_steps=50),
        patches_per_step=size.patches_per_step,
        rays_per_patch=size.rays_per_patch,
        precision="auto",
        clip_gradient=1.0,
    )
