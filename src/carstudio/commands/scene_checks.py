"""`carstudio scene replay` and `carstudio scene gap`: how close drawn cars come to photographed ones."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import tyro

from carstudio.commands.command import Outcome, Output, provenance
from carstudio.errors import InputError
from carstudio.evaluation.tables import to_markdown
from carstudio.perception.specs import make_detector
from carstudio.scene.frame_jobs import drawing_settings
from carstudio.scene.replay import replay, replay_table
from carstudio.scene.scene_file import load_scene
from carstudio.scene.simulation_gap import simulation_gap
from carstudio.scene.writing import MANIFEST


@dataclass(frozen=True, kw_only=True)
class Replay(Output):
    """Draw every car in place of itself and compare with the photographs: PSNR and SSIM per track and whole."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene."""
    out: Path
    """Folder for the replayed log, replay.json and replay.md."""
    root: Path | None = None
    """Where the log lies now, when it has moved."""
    preset: Literal["fast", "fine"] = "fast"
    """fast: a ray per pixel; fine: four."""
    depth: str = "auto"
    """How far away the background is: auto, ground or transformers:NAME_OR_FOLDER, as for `carstudio edit`."""
    workers: int = 1
    """Processes, a frame each."""
    detector: str | None = None
    """Also measure the simulation gap with this detector (onnx:FILE, transformers:NAME_OR_DIR)."""

    def saved(self) -> str:
        """Frames are whole or absent."""
        return f"the frames finished so far are saved in {self.out}; the same command goes on"

    def run(self) -> Outcome:
        """Draw, score, and look through a detector's eyes when one is named."""
        scene = load_scene(self.scene, root=self.root)
        detector = None if self.detector is None else make_detector(self.detector)
        settings = drawing_settings(self.preset, depth=self.depth)
        with self.progress() as report:
            scores = replay(
                scene,
                self.scene,
                self.out,
                workers=self.workers,
                report=report,
                settings=settings,
                provenance=provenance(),
            )
            value = {"out": str(self.out), **asdict(scores)}
            text = [to_markdown(replay_table(scores))]
            if detector is not None:
                rows = simulation_gap(scene, {"replay": self.out}, detector, self.out, report=report)
                value["simulation_gap"] = [asdict(row) for row in rows]
                text.append((self.out / "simulation_gap.md").read_text(encoding="utf-8"))
        return Outcome("\n\n".join(text), value)


@dataclass(frozen=True, kw_only=True)
class Gap(Output):
    """The same detector on the photographs and on edited logs: recall and confidence, in one table."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene."""
    edited: tuple[Path, ...]
    """Folders that `carstudio edit` or `carstudio scene replay` wrote."""
    detector: str
    """onnx:FILE or transformers:NAME_OR_DIR."""
    out: Path
    """Folder for simulation_gap.json and simulation_gap.md."""
    root: Path | None = None
    """Where the log lies now, when it has moved."""

    def run(self) -> Outcome:
        """Detect and count."""
        scene = load_scene(self.scene, root=self.root)
        for folder in self.edited:
            if not (folder / MANIFEST).is_file():
                raise InputError(f"{folder}: expected an edited log ({MANIFEST}), found none; see `carstudio edit`")
        names = {folder.name: folder for folder in self.edited}
        if len(names) < len(self.edited) or "photographs" in names:
            raise InputError("--edited: the folders' own names must differ, for they name the table's rows")
        with self.progress() as report:
            rows = simulation_gap(scene, names, make_detector(self.detector), self.out, report=report)
        text = (self.out / "simulation_gap.md").read_text(encoding="utf-8")
        return Outcome(text, {"out": str(self.out), "rows": [asdict(row) for row in rows]})
