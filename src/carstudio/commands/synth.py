"""`carstudio synth`: photographs of synthetic cars with exact truth, as a CarPatch3D store."""

from dataclasses import dataclass, fields

from carstudio.commands.build import describe, describe_unfinished
from carstudio.commands.command import Outcome, Output, plain
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize


@dataclass(frozen=True, kw_only=True)
class Synth(Output, SynthConfig):
    """Photographs of synthetic cars (or of the GLB meshes in --meshes) with exact mask, depth, box and camera."""

    def saved(self) -> str:
        """The whole shards."""
        return describe_unfinished(self.out)

    def run(self) -> Outcome:
        """Render and write the store."""
        config = SynthConfig(**{field.name: getattr(self, field.name) for field in fields(SynthConfig)})
        with self.progress() as report:
            summary = synthesize(config, report)
        return Outcome(describe(summary), plain(summary))
