"""`carstudio synth`: photographs of synthetic cars with exact truth, as a CarPatch3D store."""

from dataclasses import dataclass, fields

from carstudio.commands.build import describe, describe_unfinished
from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.sources.synthetic import SynthConfig, frozen_benchmark, synthesize


@dataclass(frozen=True, kw_only=True)
class Synth(Output, SynthConfig):
    """Photographs of synthetic cars (or of the GLB meshes in --meshes) with exact mask, depth, box and camera."""

    frozen_benchmark: bool = False
    """The set that quality is measured on: 64 cars x 8 views, 128 px, its own seed, never trained on; other sizes and
    seeds given here are set aside."""

    def saved(self) -> str:
        """The whole shards."""
        return describe_unfinished(self.out)

    def run(self) -> Outcome:
        """Render and write the store."""
        config = SynthConfig(**{field.name: getattr(self, field.name) for field in fields(SynthConfig)})
        if self.frozen_benchmark:
            config = frozen_benchmark(self.out, self.workers)
        with self.progress() as report:
            summary = synthesize(config, report)
        return Outcome(describe(summary), plain(summary))
