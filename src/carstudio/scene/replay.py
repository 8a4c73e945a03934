"""Replay: every car that was lifted is drawn where the photograph shows it, and compared with the photograph.

It says how far what is drawn is from what was there: the reconstruction, its merging with the photograph, and the fill
around it, all in one figure.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from carstudio.errors import InputError
from carstudio.evaluation.metrics import psnr, psnr_mask, ssim_map
from carstudio.evaluation.tables import Cell, Table, to_markdown
from carstudio.files import read_json, write_json, write_text
from carstudio.images import decode_image, read_image, read_image_file
from carstudio.progress import Report, silent
from carstudio.scene.drawing import read_photo
from carstudio.scene.frame_jobs import DrawingSettings
from carstudio.scene.graph import Scene
from carstudio.scene.writing import MANIFEST, write_edited

NAME = "replay"
LEAST_PIXELS = 100  # of a car in a frame: fewer tell more of the label than of the car


@dataclass(frozen=True, kw_only=True)
class TrackScore:
    """How close a track's replay comes to the photographs, means over its frames; pixels where it is drawn."""

    track_id: str
    type: str
    frames: int
    pixels: int
    psnr_mask: float  # dB
    ssim_mask: float
    nearest_m: float


@dataclass(frozen=True, kw_only=True)
class ReplayScores:
    """A replay in figures: whole frames (PSNR in dB, means over the frames) and each track."""

    frames: int
    psnr: float
    ssim: float
    tracks: tuple[TrackScore, ...]


def replayed_scene(scene: Scene) -> Scene:
    """Every track with a car drawn in all its frames; `InputError` when none has one."""
    tracks = {name: replace(t, is_drawn=True, drawn_in=None) if t.car else t for name, t in scene.tracks.items()}
    if not any(track.is_drawn for track in tracks.values()):
        raise InputError("no track of the scene has a car to replay; make the scene with `carstudio scene`")
    return replace(scene, tracks=tracks)


def replay(
    scene: Scene,
    scene_folder: Path,
    out: Path,
    *,
    workers: int = 1,
    report: Report = silent,
    settings: DrawingSettings | None = None,
    provenance: dict[str, Any] | None = None,
) -> ReplayScores:
    """Draw the replay below `out` as any edit, score it, and write replay.json and replay.md beside it."""
    replayed = replayed_scene(scene)
    write_edited(
        scene, replayed, scene_folder, out, workers=workers, report=report, settings=settings, provenance=provenance
    )
    scores = score_replay(replayed, out, report=report)
    write_json(out / f"{NAME}.json", {**asdict(scores), "provenance": provenance or {}})
    write_text(out / f"{NAME}.md", to_markdown(replay_table(scores)) + "\n")
    return scores


def score_replay(scene: Scene, out: Path, *, report: Report = silent) -> ReplayScores:
    """Compare what was drawn below `out` with the scene's photographs."""
    numbers = read_json(out / MANIFEST)["instances"]
    whole: list[tuple[float, float]] = []
    found: dict[str, list[tuple[float, float, int, float]]] = {}
    for done, frame in enumerate(scene.frames, start=1):
        report("scoring", done, len(scene.frames), frame.name)
        truth, drawn = (
            torch.from_numpy(image / 255)
            for image in (read_photo(scene.root, frame), read_image(out / "rgb" / f"{frame.name}.png"))
        )
        instances = read_instances(out / "instance" / f"{frame.name}.png")
        similarity = ssim_map(drawn, truth)
        whole.append((float(psnr(drawn, truth)), float(similarity.mean())))
        for name, track in scene.tracks.items():
            mask = torch.from_numpy(instances == numbers[name])
            if track.is_drawn_at(frame.index) and int(mask.sum()) >= LEAST_PIXELS:
                close, like = float(psnr_mask(drawn, truth, mask)), float(similarity[mask].mean())
                found.setdefault(name, []).append((close, like, int(mask.sum()), track.boxes[frame.index].center[2]))
    tracks = tuple(
        TrackScore(
            track_id=name,
            type=scene.tracks[name].type,
            frames=len(values),
            pixels=sum(value[2] for value in values),
            psnr_mask=round(float(np.mean([value[0] for value in values])), 3),
            ssim_mask=round(float(np.mean([value[1] for value in values])), 4),
            nearest_m=round(min(value[3] for value in values), 1),
        )
        for name, values in found.items()
    )
    means = np.mean(whole, axis=0)
    close, like = round(float(means[0]), 3), round(float(means[1]), 4)
    return ReplayScores(frames=len(whole), psnr=close, ssim=like, tracks=tracks)


def read_instances(path: Path) -> Any:
    """An instance image's numbers."""
    from PIL import Image

    decode_image(read_image_file(path), name=str(path), mode="L")  # broken or huge files end here
    with Image.open(path) as image:
        return np.array(image).astype(np.uint16)


def replay_table(scores: ReplayScores) -> Table:
    """Per track and as a whole."""
    rows = [
        (t.track_id, t.type, str(t.frames), f"{t.nearest_m:.1f}", f"{t.psnr_mask:.2f}", f"{t.ssim_mask:.3f}")
        for t in scores.tracks
    ]
    if scores.tracks:
        close, like = (np.mean([getattr(t, key) for t in scores.tracks]) for key in ("psnr_mask", "ssim_mask"))
        rows.append(("mean of tracks", "", "", "", f"{close:.2f}", f"{like:.3f}"))
    rows.append(("whole frames", "", str(scores.frames), "", f"{scores.psnr:.2f}", f"{scores.ssim:.3f}"))
    notes = (
        f"Tracks: over the pixels where the car is drawn, frames with at least {LEAST_PIXELS} of them. Whole frames: "
        "every pixel, those that no car covers included, which are the photograph's.",
    )
    heads = ("track", "type", "frames", "nearest (m)", "PSNR (dB) ↑", "SSIM ↑")
    cells = tuple(tuple(Cell(text) for text in row) for row in rows)
    return Table("Replay: every car drawn in place of itself, against the photographs", heads, cells, notes)
