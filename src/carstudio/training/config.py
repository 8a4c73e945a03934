"""Everything that decides a training run, as one value that is kept beside the model."""

from dataclasses import dataclass, field

from carstudio.models.car_nerf import CarNeRFConfig
from carstudio.models.zoo import ModelConfig
from carstudio.training.batches import Mirroring, PixelDraws, Supervision
from carstudio.training.losses import LossConfig
from carstudio.training.optimizers import OptimizerName
from carstudio.training.precision import Precision
from carstudio.training.schedule import ScheduleConfig


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run, data aside; the defaults are the paper's (3 x 1,024 pixels, RAdam)."""

    recipe: str = "car-nerf"
    """Name of the recipe it came from; rows and tables call the model by it."""
    model: ModelConfig = field(default_factory=CarNeRFConfig)
    """The model."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Terms of the loss."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """Learning rate."""
    supervision: Supervision = "single-view"
    """Which photo of the car an encoded photo must explain."""
    mirroring: Mirroring = "off"
    """Whether photos are flipped left to right half of the time: never, input and explained photo alike, each by its
    own draw, or that with cars of which there is but one photo."""
    box_noise: float = 0.0
    """How rough the boxes of encoded photos are made: 1: as labels and detectors are, 0: as they stand in the store."""
    patches_per_step: int = 3
    """Cars encoded per step."""
    rays_per_patch: int = 1024
    """Pixels per patch and step."""
    pixels: PixelDraws = "anywhere"
    """"anywhere": each pixel drawn from the whole crop; "in-cells": one from each cell of a grid laid over it."""
    steps: int = 500_000
    """Length of the run."""
    minutes: float | None = None
    """Stop after this much time instead, and let the learning rate follow the clock."""
    cpu_seconds: float | None = None
    """Stop after so many processor seconds instead, those of all processes of a team together; the learning rate
    follows them. What rows of a table have in common. A single process keeps to one thread of a CPU: several spend
    processor seconds waiting for each other."""
    optimizer: OptimizerName = "radam"
    """radam: the paper's; adamw: CodeNeRF's; adam: one fused kernel, the least work per step."""
    second_moment: float = 0.999
    """Adam's beta_2, whichever of the three: how slowly the mean of squared gradients forgets."""
    code_rate: float = 1.0
    """Learning rate of codes that are kept per car (CodeNeRF), as a multiple of the schedule's."""
    template_rate: float = 1.0
    """Learning rate of a mean car's own numbers (car-gaussians), as a multiple of the schedule's."""
    most_cars: int | None = None
    """Train on so many of the split's cars only; fewer are always among the more. None: on all."""
    least_views: int = 1
    """Leave out cars with fewer photos in the training part (the paper's multi-view comparison: 2)."""
    clip_gradient: float | None = None
    """Largest gradient norm; None: not clipped, as released."""
    precision: Precision = "float32"
    """Number format of matrix products; "auto": bfloat16 where the device has matrix units for it."""
    seed: int = 0
    """Start of all randomness."""
    split: str | None = "instance"
    """Split whose training part is used; None: all kept patches."""
    log_every: int = 20
    """Steps per line of log.jsonl."""
    save_every: int = 500
    """Steps between checkpoints."""
