"""`carstudio demo`: the whole path on synthetic cars, from nothing to an HTML report."""

import time
from dataclasses import dataclass
from pathlib import Path

from carstudio.commands.command import Outcome, Output
from carstudio.demo import DemoConfig, run_demo
from carstudio.errors import InputError
from carstudio.recipes import recipe


@dataclass(frozen=True, kw_only=True)
class Demo(Output):
    """Photograph synthetic cars, train a model, show cars it never saw from all around, write a report."""

    out: Path = Path("out/demo")
    """Folder of everything the demo makes; index.html in it is the report. Started again, it goes on."""
    cars: int = 200
    """Synthetic cars; every tenth is kept for testing."""
    views: int = 12
    """Photographs of each."""
    minutes: float = 5.0
    """Training time."""
    model: str = "car-gaussians"
    """Recipe of the model: car-gaussians, car-nerf-small, ..."""
    seed: int = 0
    """Start of all randomness."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def saved(self) -> str:
        """The steps, and the training's last checkpoint."""
        return f"what is finished in {self.out} is kept and not done again"

    def run(self) -> Outcome:
        """Run the path; what an earlier call finished is not done again."""
        if self.cars < 4 or self.views < 2:
            raise InputError(f"--cars must be at least 4 and --views at least 2, found {self.cars} and {self.views}")
        recipe(self.model)  # says which there are
        started = time.monotonic()
        config = DemoConfig(
            out=self.out,
            cars=self.cars,
            views=self.views,
            minutes=self.minutes,
            model=self.model,
            seed=self.seed,
            device=self.device,
        )
        with self.progress() as report:
            result = run_demo(config, report)
        seconds = time.monotonic() - started
        text = (
            f"cars never seen, novel view: PSNR {result['psnr']:.2f} dB, SSIM {result['ssim']:.3f}, "
            f"mask IoU {result['mask_iou']:.3f}\nreport: {self.out / 'index.html'}   ({seconds / 60:.1f} minutes)"
        )
        return Outcome(text, {**result, "report": str(self.out / "index.html"), "seconds": seconds})
