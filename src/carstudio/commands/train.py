"""`carstudio train`: recipe + store -> a trained model."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from carstudio.commands.command import Outcome, Output, plain, provenance, split_of
from carstudio.dataset.store import PatchStore, open_store
from carstudio.errors import InputError
from carstudio.models.interface import CategoryModel
from carstudio.recipes import recipe, supervised
from carstudio.report.panels import views_panel
from carstudio.signals import held_back_stops
from carstudio.training.batches import Supervision
from carstudio.training.config import TrainConfig
from carstudio.training.optimizers import OptimizerName
from carstudio.training.resume import has_state, saved_step
from carstudio.training.team import is_first_process
from carstudio.training.trainer import train


@dataclass(frozen=True, kw_only=True)
class Train(Output):
    """Train a category model on a CarPatch3D store."""

    recipe: tyro.conf.Positional[str]
    """car-gaussians (fast), car-gaussians-preview (fastest), car-nerf (the paper's), car-nerf-no-mask,
    car-nerf-as-released or car-nerf-small; baselines at their papers' sizes: pixelnerf-resnet, pixelnerf-resnet-global,
    pixelnerf-mlp, autorf, autorf-occupancy, code-nerf."""
    data: Path
    """The CarPatch3D store."""
    out: Path
    """Folder of the run: model.safetensors, model.json, log.jsonl, pictures/."""
    steps: int | None = None
    """Length of the run in steps (the recipe's own when absent)."""
    minutes: float | None = None
    """Length of the run in minutes instead."""
    cpu_seconds: float | None = None
    """Length of the run in processor seconds instead, all processes together: what fair comparisons share."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1, mps, ..."""
    processes: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Processes of one thread each that share every step's patches; on a CPU that is much quicker than threads. For
    several GPUs or machines start the same command by torchrun instead."""
    seed: int = 0
    """Start of all randomness."""
    init: Path | None = None
    """Run whose weights to start from (same recipe), such as one trained on many synthetic cars."""
    resume: bool = False
    """Go on with the run in --out."""
    split: str | None = "instance"
    """Split whose training part is used; "None" for all kept patches."""
    learning_rate: float | None = None
    """First learning rate; the last one keeps its ratio to it (the recipe's own when absent; less for a
    short run from --init: for fields a tenth, or they forget what they started from)."""
    patches_per_step: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Photos of a step (the recipe's own when absent): more for several processes, which pay for a step each."""
    supervision: Supervision | None = None
    """Which photo an encoded photo must explain (the recipe's own when absent)."""
    box_noise: float | None = None
    """How rough the boxes of encoded photos are made in training; 0: not at all (the recipe's own when absent)."""
    optimizer: OptimizerName | None = None
    """radam (the paper's), adamw, or adam in one fused kernel (the recipe's own when absent)."""
    pictures: Annotated[int, tyro.conf.arg(metavar="N")] = 6
    """Cars in the picture drawn at every checkpoint; 0: none."""

    def config(self) -> TrainConfig:
        """The recipe with this command's changes."""
        config = replace(recipe(self.recipe), seed=self.seed, split=split_of(self.split), minutes=self.minutes)
        if self.minutes is not None and self.cpu_seconds is not None:
            raise InputError("--minutes and --cpu-seconds both say how long the run is; give one")
        config = replace(config, cpu_seconds=self.cpu_seconds, optimizer=self.optimizer or config.optimizer)
        if self.steps is not None:
            config = replace(config, steps=self.steps)
        if self.patches_per_step is not None:
            if self.patches_per_step < 1:
                raise InputError(f"--patches-per-step must be 1 or more, found {self.patches_per_step}")
            config = replace(config, patches_per_step=self.patches_per_step)
        if self.supervision is not None:
            config = supervised(config, self.supervision)
        if self.box_noise is not None:
            if self.box_noise < 0:
                raise InputError(f"--box-noise must be 0 or more, found {self.box_noise}")
            config = replace(config, box_noise=self.box_noise)
        if self.learning_rate is not None:
            if not self.learning_rate > 0:
                raise InputError(f"--learning-rate must be positive, found {self.learning_rate}")
            ratio = config.schedule.last / config.schedule.first
            schedule = replace(config.schedule, first=self.learning_rate, last=ratio * self.learning_rate)
            config = replace(config, schedule=schedule)
        return config

    def saved(self) -> str:
        """The step to go on from."""
        return describe_checkpoint(self.out)

    def again(self, arguments: list[str]) -> list[str]:
        """With --resume, once there is a checkpoint."""
        is_asked = "--resume" in arguments or not has_state(self.out)
        return arguments if is_asked else [*arguments, "--resume"]

    def run(self) -> Outcome:
        """Train; pictures of unseen cars go to OUT/pictures."""
        store = open_store(self.data)

        def draw(model: CategoryModel, step: int) -> None:
            if self.pictures:
                views_panel(
                    model, store, self.out / "pictures" / f"step-{step:07d}.png", split_of(self.split), self.pictures
                )

        with self.progress() as report, held_back_stops() as stops:
            summary = train(
                self.config(),
                store,
                self.out,
                device=self.device,
                resume=self.resume,
                init=self.init,
                provenance={**provenance(), **store_origin(store)},
                report=report,
                on_save=draw,
                should_stop=lambda: bool(stops),
                processes=self.processes,
            )
        if not is_first_process():
            return Outcome("", {})
        text = (
            f"{self.recipe}: {summary.steps} steps in {summary.seconds:.0f} s ({summary.rays_per_s:,.0f} rays/s), "
            f"{summary.precision}, {summary.starts_from}; PSNR on the last batch's car pixels {summary.psnr:.2f} dB\n"
            f"model in {self.out}"
        )
        return Outcome(text, plain(summary))


def describe_checkpoint(run: Path) -> str:
    """What a stopped training leaves."""
    step = saved_step(run) if has_state(run) else None
    return f"no checkpoint is there yet in {run}" if step is None else f"step {step} is saved in {run}"


def store_origin(store: PatchStore) -> dict[str, str]:
    """What a model file says about its data."""
    return {"data": store.path.name, "data_sha256": store.data_sha256}
