"""The training loop: one straight line per step, everything random drawn from (seed, step)."""

import dataclasses
import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.store import PatchStore, open_store
from carstudio.devices import one_thread, pick_device
from carstudio.errors import InputError, Interrupted
from carstudio.files import remove_partials
from carstudio.locks import LOCK_NAME, FolderLock
from carstudio.models.interface import CategoryModel
from carstudio.models.zoo import build_model, with_cars
from carstudio.progress import Report, silent
from carstudio.rendering.rays import to_canonical
from carstudio.training.batches import StepSampler, generator_for, training_patches
from carstudio.training.checkpoint import describe_model, load_weights_of, save_model
from carstudio.training.config import TrainConfig
from carstudio.training.log import LOG, TrainingLog
from carstudio.training.losses import code_length, masked_psnr, training_loss
from carstudio.training.optimizers import build_optimizer, clip
from carstudio.training.precision import autocast, resolve_precision
from carstudio.training.resume import STATE, TrainingState, load_state, save_state
from carstudio.training.schedule import learning_rate
from carstudio.training.team import Team, team_of, torchrun_device


@dataclass(frozen=True)
class TrainSummary:
    """What a finished run did."""

    folder: str
    steps: int
    seconds: float
    cpu_seconds: float
    rays_per_s: float
    psnr: float
    starts_from: str
    precision: str
    sha256: str


def train(
    config: TrainConfig,
    store: PatchStore,
    out: Path,
    *,
    device: str = "auto",
    resume: bool = False,
    init: Path | None = None,
    provenance: dict[str, Any] | None = None,
    report: Report = silent,
    on_save: Callable[[CategoryModel, int], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    processes: int = 1,
) -> TrainSummary:
    """Train a model on a store's kept patches and leave it in `out` (model, log, state to resume from).

    On a CPU `processes` share each step's patches (`training/team.py`); a script that asks for them needs
    `if __name__ == "__main__":`, as they import it. Under torchrun every process calls this.

    `init` is a trained model of the same config whose weights the run starts from (a resumed run has its own).
    `on_save(model, step)` is called after each checkpoint, for pictures. Once `should_stop()` is true, the state of the
    finished step is saved and `Interrupted` raised. Killed at any moment and resumed, a run by steps ends with the same
    bits on a CPU as an uninterrupted one (a run by minutes follows the clock). `out` is locked while it is written.
    """
    place = torchrun_device(pick_device(device))
    if not 1 <= processes <= config.patches_per_step:
        raise InputError(
            f"processes share a step's patches: expected 1 to {config.patches_per_step}, found {processes}"
        )
    along = partial(_train_along, config, store.path, out, device, init)
    keeps_to_one = config.cpu_seconds is not None and place.type == "cpu"
    with one_thread() if keeps_to_one else nullcontext(), team_of(processes, place, along) as team:
        run = _Run(config, store, out, place, provenance or {}, team)
        if not team.is_first:
            _steps_along(run, init)
            return run.summary()
        refuse_wrong_start(out, resume=resume)
        with FolderLock(out):
            remove_partials(out)
            run.begin(init=init)
            try:
                _steps(run, report, on_save or _draw_nothing, should_stop)
            finally:
                run.close()
        team.wait()
    return run.summary()


def _train_along(config: TrainConfig, data: Path, out: Path, device: str, init: Path | None, team: Team) -> None:
    """What the other processes of a team do."""
    _steps_along(_Run(config, open_store(data), out, pick_device(device), {}, team), init)


def _steps_along(run: "_Run", init: Path | None) -> None:
    """The same steps as the first process, with nothing written; what stops that one stops this."""
    run.start(init=init)
    while not run.is_done():
        run.one_step()
        if run.is_stopped:
            raise Interrupted
    run.team.wait()


def _steps(
    run: "_Run", report: Report, on_save: Callable[[CategoryModel, int], None], should_stop: Callable[[], bool]
) -> None:
    """From where the run stands to its end."""
    is_done = run.is_done()
    if is_done:
        run.save()  # resumed at its end: the model may be that of an earlier step
    if is_done or (run.step > 0 and run.step % run.config.save_every == 0):
        on_save(run.model, run.step)  # a kill may have come between the checkpoint and its picture
    while not is_done:
        figures = run.one_step(should_stop)
        is_done = run.is_done()  # asked once per step: the clock runs on
        if run.step % run.config.log_every == 0 or is_done:
            run.log(figures)
        report("training", *run.progress(), f"PSNR {run.psnr:.2f} dB  {run.rays_per_s:,.0f} rays/s")
        if run.step % run.config.save_every == 0 or is_done:
            run.save()
            on_save(run.model, run.step)
        if not is_done and run.is_stopped:
            run.save_state()
            raise Interrupted


def _draw_nothing(model: CategoryModel, step: int) -> None:
    """The default of `on_save`."""


def refuse_wrong_start(out: Path, *, resume: bool) -> None:
    """`InputError` when there is a checkpoint and no --resume, or neither a checkpoint nor a sign of a run begun."""
    if (out / STATE).exists():
        if not resume:
            raise InputError(f"{out} holds a run already; add --resume to go on with it, or choose another --out")
    elif resume and not any((out / name).exists() for name in (LOCK_NAME, LOG)):
        raise InputError(f"{out}: nothing to resume ({STATE} is missing); start without --resume")


class _Run:
    """The parts of a run that live from step to step."""

    def __init__(
        self,
        config: TrainConfig,
        store: PatchStore,
        out: Path,
        device: torch.device,
        provenance: dict[str, Any],
        team: Team,
    ) -> None:
        self.config, self.out, self.device, self.provenance, self.team = config, out, device, provenance, team
        patches = training_patches(
            store, split=config.split, most_cars=config.most_cars, least_views=config.least_views
        )
        torch.manual_seed(config.seed)
        self.model_config = with_cars(config.model, tuple(sorted(set(patches.values()))))
        self.model = build_model(self.model_config).to(device)
        self.starts_from = ""
        self.optimizer = build_optimizer(
            self.model,
            config.optimizer,
            rate=config.schedule.first,
            second_moment=config.second_moment,
            code_rate=config.code_rate,
            template_rate=config.template_rate,
        )
        self.step, self.seconds, self.cpu_seconds, self.psnr, self.rays_per_s = 0, 0.0, 0.0, math.nan, 0.0
        self.is_stopped = False
        cache = PatchCache(store, self.model.encoder_side_px)
        self.sampler = StepSampler(
            cache,
            list(patches),
            patches_per_step=config.patches_per_step,
            supervision=config.supervision,
            seed=config.seed,
            mirroring=config.mirroring,
            box_noise=config.box_noise,
            pixels=config.pixels,
        )

    def begin(self, *, init: Path | None) -> None:
        """Start, and open the log."""
        self.start(init=init)
        self.trainlog = TrainingLog(self.out, resume_step=self.step)
        self.psnr = self.trainlog.last_row.get("psnr", math.nan)

    def start(self, *, init: Path | None) -> None:
        """Put the first weights in place (the last checkpoint's if there is one) and start the clock."""
        if (self.out / STATE).exists():
            self._restore(load_state(self.out))
        elif init is not None:
            self.starts_from = load_weights_of(init, self.model, self.model_config)
        else:
            self.starts_from = f"encoder from {self.model.load_pretrained_parts()}"
        self._resumed_step, self._resumed_seconds = self.step, self.seconds
        self._resumed_cpu_seconds = self.cpu_seconds
        self._started, self._cpu_started = time.monotonic(), time.process_time()

    def _restore(self, state: TrainingState) -> None:
        state.into(self.model, self.optimizer)
        self.step, self.starts_from = state.step, state.starts_from
        self.seconds, self.cpu_seconds = state.seconds, state.cpu_seconds

    def fraction(self) -> float:
        """Share of the run's budget that is spent."""
        if self.config.minutes is not None:
            return min(1.0, self.seconds / (60 * self.config.minutes))
        if self.config.cpu_seconds is not None:
            return min(1.0, self.cpu_seconds / self.config.cpu_seconds)
        return self.step / self.config.steps

    def is_done(self) -> bool:
        return self.step > 0 and self.fraction() >= 1.0

    def progress(self) -> tuple[int, int]:
        """(done, total) for a progress bar: steps, or seconds of a run by time."""
        if self.config.minutes is not None:
            return round(self.seconds), round(60 * self.config.minutes)
        if self.config.cpu_seconds is not None:
            return round(self.cpu_seconds), round(self.config.cpu_seconds)
        return self.step, self.config.steps

    def _elapsed(self) -> float:
        return self._resumed_seconds + time.monotonic() - self._started

    def one_step(self, should_stop: Callable[[], bool] = lambda: False) -> dict[str, float]:
        """Encode, trace, compare, update; returns the loss terms (the whole team's).

        Time and stops are the first process's, so that all follow one schedule and end at one step.
        """
        config = self.config
        rate = learning_rate(config.schedule, self.step, self.fraction())
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group["multiple"]
        rows = self.team.share(config.patches_per_step)
        patches, pixels = self.sampler.batch(self.step, config.rays_per_patch, rows)
        patches, pixels = patches.to(self.device), pixels.to(self.device)
        jitter = generator_for(config.seed, self.step, "jitter", self.team.rank)

        self.model.train()
        with autocast(config.precision, self.device):
            latents = self.model.encode(patches)
            renderings = self.model.render_levels(pixels.rays, latents, pixels.box, jitter)
        counts = pixels.is_known & to_canonical(pixels.rays, pixels.box).hit
        terms = training_loss(renderings, pixels.rgb, pixels.alpha, counts, config.loss)
        if config.loss.code_weight:
            terms["codes"] = config.loss.code_weight * code_length(latents)
        loss = torch.stack(list(terms.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        values = [float(term.detach()) for term in terms.values()]
        seen = masked_psnr(renderings[-1], pixels.rgb, pixels.alpha * counts)
        (*values, self.psnr), (self.seconds, stops), (spent,) = self.team.average(
            list(self.model.parameters()),
            weight=float(counts.sum()),
            means=[*values, seen],
            from_first=[self._elapsed(), float(should_stop())],
            sums=[time.process_time() - self._cpu_started],
        )
        self.cpu_seconds = self._resumed_cpu_seconds + spent
        figures, self.is_stopped = dict(zip(terms, values, strict=True)), stops > 0
        self._refuse_nan(figures, patches.instance_ids)
        if config.clip_gradient is not None:
            clip(list(self.model.parameters()), config.clip_gradient)
        self.optimizer.step()

        self.step += 1
        steps_here = self.step - self._resumed_step
        rays = steps_here * config.patches_per_step * config.rays_per_patch
        self.rays_per_s = rays / max(time.monotonic() - self._started, 1e-9)
        return {"loss": sum(figures.values()), **figures, "learning_rate": rate, "psnr": self.psnr}

    def _refuse_nan(self, figures: dict[str, float], instance_ids: tuple[str, ...]) -> None:
        broken = [name for name, value in figures.items() if not math.isfinite(value)]
        if broken:
            raise FloatingPointError(
                f"step {self.step}: loss term {broken[0]} is {figures[broken[0]]} for cars {list(instance_ids)}; "
                f"the weights are not changed by it. The last checkpoint in {self.out} is sound, but going on from it "
                "meets the same numbers again: --resume with a lower --learning-rate, or with another --seed (other "
                "batches from there on)"
            )

    def log(self, figures: dict[str, float]) -> None:
        """One line of the log."""
        row: dict[str, Any] = {"step": self.step, **figures}
        if self.config.minutes is not None:
            row["seconds"] = round(self.seconds, 3)
        if self.config.cpu_seconds is not None:
            row["cpu_seconds"] = round(self.cpu_seconds, 3)
        self.trainlog.write(row)

    def save(self) -> None:
        """The model for its users and the log, then the state: what goes on from it finds the others there."""
        provenance = {
            **self.provenance,
            "recipe": self.config.recipe,
            "training": dataclasses.asdict(self.config),
            "precision": resolve_precision(self.config.precision, self.device),
            "starts_from": self.starts_from,
            "step": self.step,
        }
        save_model(self.out, self.model, self.model_config, provenance)
        self.save_state()

    def save_state(self) -> None:
        """What the run goes on from; the log reaches the disk before it."""
        self.trainlog.sync()
        state = TrainingState.of(
            self.model,
            self.optimizer,
            step=self.step,
            seconds=self.seconds,
            cpu_seconds=self.cpu_seconds,
            starts_from=self.starts_from,
        )
        save_state(self.out, state)

    def close(self) -> None:
        self.trainlog.close()

    def summary(self) -> TrainSummary:
        return TrainSummary(
            folder=str(self.out),
            steps=self.step,
            seconds=round(self.seconds, 3),
            cpu_seconds=round(self.cpu_seconds, 3),
            rays_per_s=round(self.rays_per_s, 1),
            psnr=round(self.psnr, 3),
            starts_from=self.starts_from,
            precision=resolve_precision(self.config.precision, self.device),
            sha256=describe_model(self.out).sha256,
        )
