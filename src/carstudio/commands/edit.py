"""`carstudio edit`: a scene and an edit file -> edited frames with depth, instance masks and labels."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from carstudio.commands.command import Outcome, Output, provenance
from carstudio.errors import InputError
from carstudio.files import make_folder
from carstudio.locks import FolderLock
from carstudio.scene.edit_file import read_edit_file, write_edits
from carstudio.scene.editing import Edited, apply_edits
from carstudio.scene.frame_jobs import drawing_settings
from carstudio.scene.graph import Scene
from carstudio.scene.random_edits import Traffic, random_traffic
from carstudio.scene.scene_file import load_scene, save_scene
from carstudio.scene.shelf import CarShelf, copy_cars
from carstudio.scene.writing import write_edited

SCENE = "scene"  # below the output: the edited scene, to look into or to edit further
EDITS = "edits.yaml"


@dataclass(frozen=True, kw_only=True)
class Edit(Output):
    """Edit a driving log: insert, move, rotate, resize, delete, replace, recolour cars, let them drive."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene (`carstudio scene`)."""
    edits: tyro.conf.Positional[Path | None] = None
    """The edit file, YAML or JSON; see docs/edit_a_log.md."""
    out: Path
    """Folder to write: rgb/ depth/ instance/ semantic/ label_2/ video.mp4 manifest.json index.html, and the edited
    scene in scene/."""
    random: int | None = None
    """Instead of an edit file: put in so many cars, on the ground, along the road, none in another."""
    seed: int = 0
    """Which cars, and where (--random)."""
    cars: tuple[Path, ...] = ()
    """CAR folders from elsewhere; edits name them by the folder's name."""
    model: Path | None = None
    """The run that cars were made with, where it is not a bundled model."""
    root: Path | None = None
    """Where the log lies now, when it has been moved since the scene was made."""
    preset: Literal["fast", "fine"] = "fast"
    """fast: one ray per pixel; fine: four, which is smoother at contours."""
    depth: str = "auto"
    """How far away the background is. auto: the log's own depth or LiDAR where it has one, else the ground;
    transformers:NAME_OR_FOLDER: a monocular network's, made metric by LiDAR or the ground; ground: ground alone."""
    dry_run: bool = False
    """Write only the edited scene and tell what looks wrong; draw nothing."""
    workers: int = 0
    """Processes that draw; 0: one per core."""

    def saved(self) -> str:
        """Frames are whole or absent."""
        return f"the frames finished so far are saved in {self.out}"

    def run(self) -> Outcome:
        """Edit, then draw."""
        if (self.edits is None) == (self.random is None):
            raise InputError("expected either an edit file or --random N; see docs/edit_a_log.md")
        if self.workers < 0:
            raise InputError(f"--workers must be 0 (one per core) or more, found {self.workers}")
        settings = drawing_settings(self.preset, depth=self.depth, model=self.model)
        scene = load_scene(self.scene, root=self.root)
        make_folder(self.out)
        with FolderLock(self.out / SCENE):
            original, edited, problems = self._edit(scene)
            save_scene(self.out / SCENE, edited.scene)
        warnings = [*problems, *edited.warnings]
        value: dict[str, Any] = {"out": str(self.out), "warnings": warnings}
        told = [f"  warning: {warning}" for warning in warnings]
        if self.dry_run:
            return Outcome("\n".join([f"{self.out / SCENE}: edited, nothing drawn", *told]), value)
        with self.progress() as report:
            summary = write_edited(
                original,
                edited.scene,
                self.out / SCENE,
                self.out,
                workers=self.workers or os.cpu_count() or 1,
                report=report,
                settings=settings,
                provenance=provenance(),
            )
        text = f"{self.out}: {len(scene.frames)} frames; look at {self.out / 'index.html'}"
        return Outcome("\n".join([text, *told]), {**value, "frames": summary.num_frames, "kept": summary.kept})

    def _edit(self, scene: Scene) -> tuple[Scene, Edited, tuple[str, ...]]:
        """The scene as it was and as it is now, both with their cars below the output's own scene."""
        models = () if self.model is None else (self.model,)
        shelf = CarShelf(self.out / SCENE, models=models, more=self.cars)
        original = copy_cars(scene, CarShelf(self.scene), shelf)
        if self.edits is not None:
            traffic = Traffic(tuple(read_edit_file(self.edits)), ())
        else:
            traffic = random_traffic(original, shelf, self.random or 0, seed=self.seed)
        write_edits(self.out / SCENE / EDITS, traffic.edits)
        return original, apply_edits(original, traffic.edits, shelf), traffic.problems
