"""`carstudio scene ACTION`: make a scene from a driving log, and look into one. One class per action."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from carstudio.commands.command import Outcome, Output, provenance
from carstudio.commands.scene_checks import Gap, Replay
from carstudio.devices import pick_device
from carstudio.errors import InputError
from carstudio.files import write_json
from carstudio.fitting.optimise import FitConfig
from carstudio.images import write_png
from carstudio.locks import FolderLock
from carstudio.perception.specs import make_segmenter
from carstudio.progress import Report
from carstudio.scene.edit_file import nearest
from carstudio.scene.graph import CarRef, Scene
from carstudio.scene.kitti import Log, open_det_log, open_mot_log
from carstudio.scene.lifting import SCENE_FIT, LiftConfig, lift_tracks
from carstudio.scene.paint import parse_colour
from carstudio.scene.recolour import CarPictures, PaintConfig, Way, pictures_of, recolour_car
from carstudio.scene.recolour_measure import own_colour, recolour_truth, score_recolour, strip
from carstudio.scene.scene_file import load_scene, save_scene
from carstudio.scene.shelf import CarShelf
from carstudio.scene.views import ViewConfig

_SHOWN_PROBLEMS = 20


@dataclass(frozen=True, kw_only=True)
class MakeScene(Output):
    """What every source shares."""

    root: Path
    """Folder of the source in its official layout."""
    out: Path
    """The scene to write: scene.json and cars/."""
    frames: str | None = None
    """Frame numbers A-B, both included; all when absent."""
    model: str = "car-gaussians"
    """Model that the cars are fitted with: folder of a run, or a bundled model's name."""
    segmenter: str = "grabcut"
    """Who finds masks: grabcut (no weights), sam[:NAME_OR_DIR], sam2[:NAME_OR_DIR], onnx:FILE, precomputed:PATH."""
    types: tuple[str, ...] = ("Car", "Van")
    """Label types that become cars to edit; others stay as the photographs show them."""
    views: tyro.conf.OmitArgPrefixes[ViewConfig] = field(default_factory=ViewConfig)
    """Which photographs of a car are taken."""
    fit: tyro.conf.OmitArgPrefixes[FitConfig] = SCENE_FIT
    """How a car is fitted to them."""
    no_mirrors: bool = False
    """Do not take photographs flipped left to right for the side that no photograph shows."""
    rays: int = 256
    """Pixels per photograph and step."""
    seed: int = 0
    """Which pixels."""
    device: str = "auto"
    """auto, cpu, cuda, mps, ..."""

    def saved(self) -> str:
        """Cars are whole or absent."""
        return f"the cars finished so far are saved in {self.out / 'cars'}"

    def open_log(self, report: Report) -> Log:
        """The log to make the scene from."""
        raise NotImplementedError

    def run(self) -> Outcome:
        """Read the log, lift its cars, write the scene."""
        device, segmenter = pick_device(self.device), make_segmenter(self.segmenter)
        config = LiftConfig(
            model=self.model,
            types=self.types,
            views=self.views,
            fit=self.fit,
            mirrors=not self.no_mirrors,
            rays=self.rays,
            seed=self.seed,
        )
        with FolderLock(self.out), self.progress() as report:
            log = self.open_log(report)
            lifted = lift_tracks(
                log,
                self.out,
                segmenter,
                config,
                segmenter_name=self.segmenter,
                device=device,
                provenance=provenance(),
                report=report,
            )
            save_scene(self.out, lifted.scene)
        problems = [*log.problems, *lifted.problems]
        text = "\n".join([f"{self.out}: {describe(lifted.scene)}", *_fits(lifted.psnr), *_listed(problems)])
        value = {"out": str(self.out), **counts(lifted.scene), "psnr_mask": lifted.psnr, "problems": problems}
        return Outcome(text, value)


@dataclass(frozen=True, kw_only=True)
class FromKittiMot(MakeScene):
    """One sequence of KITTI tracking: a car per track, poses and LiDAR where they are there."""

    sequence: str = "0000"
    """The sequence, such as 0001."""

    def open_log(self, report: Report) -> Log:
        """The sequence."""
        return open_mot_log(self.root, self.sequence, frames=self.frames, report=report)


@dataclass(frozen=True, kw_only=True)
class FromKittiDet(MakeScene):
    """Photographs of KITTI detection: each car is seen once, and the camera's path is unknown."""

    def open_log(self, report: Report) -> Log:
        """The photographs."""
        return open_det_log(self.root, frames=self.frames, report=report)


@dataclass(frozen=True, kw_only=True)
class Info(Output):
    """Count a scene's frames and tracks; list the tracks with their frames."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene."""

    def run(self) -> Outcome:
        """Print the tracks."""
        scene = load_scene(self.scene)
        lines = [f"{self.scene}: {describe(scene)}"]
        lines += [f"  {line}" for line in track_lines(scene)]
        return Outcome("\n".join(lines), {"out": str(self.scene), **counts(scene)})


@dataclass(frozen=True, kw_only=True)
class Recolour(Output):
    """Show a track's car in another colour in all ways there are, and measure how well the colour follows."""

    scene: tyro.conf.Positional[Path]
    """Folder of the scene."""
    track: str
    """Whose car."""
    colour: str
    """'#rrggbb', or a name such as red."""
    mix_with: str | None = None
    """Another track, whose texture is mixed in; the ways are two without it."""
    out: Path
    """Folder to write: strip.png (the car, what was asked for, paint, paper, mix) and scores.json."""
    side: int = 160
    """Side of a picture in px."""

    def run(self) -> Outcome:
        """Recolour, compare, draw the strip."""
        if not 16 <= self.side <= 1024:
            raise InputError(f"--side must be 16 to 1024, found {self.side}")
        scene = load_scene(self.scene)
        refs = {name: track.car for name, track in scene.tracks.items() if track.car is not None}
        for name in (self.track, self.mix_with):
            if name is not None and name not in refs:
                raise InputError(f"no car of a track {name!r}{nearest(name, refs, 'tracks with a car')}")
        shelf = CarShelf(self.out)
        taken = {name: shelf.take(CarShelf(self.scene).folder(ref.name), ref.name) for name, ref in refs.items()}
        scores = self._compare(shelf, taken)
        write_json(self.out / "scores.json", scores)
        lines = [
            f"  {way:<6} paint {each['paint_error']:.1f} (before {each['paint_error_before']:.1f}), rest "
            f"{each['rest_error']:.1f}, shape {'the same to the bit' if each['is_same_shape'] else 'changed'}"
            for way, each in scores.items()
        ]
        text = [f"{self.out / 'strip.png'}: mean CIEDE2000 to what was asked for", *lines]
        return Outcome("\n".join(text), {"out": str(self.out), "scores": scores})

    def _compare(self, shelf: CarShelf, refs: dict[str, CarRef]) -> dict[str, Any]:
        ref, colour = refs[self.track], parse_colour(self.colour)
        car, config = shelf.load(ref), PaintConfig(side_px=self.side)
        model = shelf.model_of(car)
        truth = recolour_truth(model, car, colour, config)
        other = None if self.mix_with is None else refs[self.mix_with]
        ways: list[Way] = ["paint", "paper"] if other is None else ["paint", "paper", "mix"]
        pictures: list[CarPictures] = []
        scores: dict[str, Any] = {}
        for way in ways:
            new = shelf.load(recolour_car(shelf, ref, way=way, colour=colour, other=other if way == "mix" else None))
            pictures.append(pictures_of(shelf.model_of(new), new, config))
            aim = truth
            if other is not None and way == "mix":
                theirs = shelf.load(other)
                aim = recolour_truth(model, car, own_colour(shelf.model_of(theirs), theirs, config), config)
            scores[way] = asdict(score_recolour(aim, pictures[-1]))
        write_png(self.out / "strip.png", strip(pictures, truth, config))
        return scores


Scenes = (
    Annotated[FromKittiMot, subcommand("from-kitti-mot")]
    | Annotated[FromKittiDet, subcommand("from-kitti-det")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Recolour, subcommand("recolour")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Gap, subcommand("gap")]
)


def counts(scene: Scene) -> dict[str, Any]:
    """A scene in numbers."""
    tracks = {
        name: {"type": track.type, "frames": sorted(track.boxes), "car": track.car.name if track.car else None}
        for name, track in scene.tracks.items()
    }
    return {"frames": len(scene.frames), "tracks": tracks}


def describe(scene: Scene) -> str:
    """A scene in a line."""
    posed = sum(frame.world_from_camera is not None for frame in scene.frames)
    lidar = sum(frame.lidar is not None for frame in scene.frames)
    cars = sum(track.car is not None for track in scene.tracks.values())
    return (
        f"{len(scene.frames)} frames ({posed} with a pose, {lidar} with LiDAR), {len(scene.tracks)} tracks, "
        f"{cars} of them with a car"
    )


def track_lines(scene: Scene) -> list[str]:
    """One line per track: id, type, frames, distance, car."""
    lines = []
    for name, track in scene.tracks.items():
        indices = sorted(track.boxes)
        if not indices:
            continue
        depths = [track.boxes[index].center[2] for index in indices]
        car = track.car.name if track.car else "no car"
        lines.append(
            f"{name:>12}  {track.type:<10} frames {indices[0]}-{indices[-1]} ({len(indices)}), "
            f"{min(depths):.0f}-{max(depths):.0f} m ahead, {car}"
        )
    return lines


def _fits(psnr: dict[str, float | None]) -> list[str]:
    return [f"  track {name}: PSNR {value:.1f} dB on its pixels" for name, value in psnr.items() if value is not None]


def _listed(problems: list[str]) -> list[str]:
    lines = [f"  problem: {problem}" for problem in problems[:_SHOWN_PROBLEMS]]
    if len(problems) > _SHOWN_PROBLEMS:
        lines.append(f"  ... and {len(problems) - _SHOWN_PROBLEMS} more problems; --json lists them all")
    return lines
