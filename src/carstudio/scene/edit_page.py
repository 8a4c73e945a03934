"""The page of an edited log: video, frames before and after, and a table of the drawn objects."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from carstudio.evaluation.tables import Cell, Table
from carstudio.images import encode_jpeg, read_image
from carstudio.report.colours import CYAN, PINK
from carstudio.report.overlays import draw_box2d, draw_box3d
from carstudio.report.page import Comparison, KeyFigure, Page, Picture, Section, Text, write_page
from carstudio.scene.drawing import read_photo
from carstudio.scene.graph import Scene, SceneFrame
from carstudio.scene.truth import truths_of

_SHOWN = 4  # frames on the page, evenly spread
_WIDTH_PX = 900


def write_edit_page(
    original: Scene,
    edited: Scene,
    out: Path,
    records: Sequence[Mapping[str, Any]],
    manifest: Mapping[str, Any],
) -> None:
    """Write `index.html`; the video stays a file beside it, the stills are in it."""
    places = np.linspace(0, len(records) - 1, min(_SHOWN, len(records)))
    rows = []
    for i in sorted({int(place) for place in places}):
        frame, record = edited.frames[i], records[i]
        after = read_image(out / "rgb" / f"{record['name']}.png")
        before = read_photo(original.root, frame)
        labelled = draw_truth(after, frame, record)
        pictures = [Picture(source=_small(image), alt=f"frame {frame.name}") for image in (before, after, labelled)]
        rows.append((frame.name, pictures))
    filled = sum(record["filled_px"] for record in records)
    from_frames = sum(record["filled_from_frames_px"] for record in records)
    drawn, removed = manifest["drawn_tracks"], manifest["removed_tracks"]
    figures = (
        KeyFigure(value=str(len(records)), label="frames"),
        KeyFigure(value=str(len(drawn)), label="objects drawn", detail=", ".join(drawn[:8])),
        KeyFigure(value=str(len(removed)), label="objects taken out", detail=", ".join(removed[:8])),
        KeyFigure(
            value=f"{100 * from_frames / filled:.0f} %" if filled else "none",
            label="of what they hid, seen in other frames",
            detail="the rest is inpainted" if filled else "nothing had to be filled",
        ),
    )
    page = Page(
        title="Edited log",
        lead=f"{edited.source}, licence of the photographs: {edited.licence}.",
        hero=Picture(source="video.mp4", alt="the edited log") if manifest["video"] else None,
        figures=figures,
        sections=(
            Section(
                title="Frames",
                blocks=[
                    Comparison(("photograph", "edited", "new labels"), rows),
                    Text("Blue: 3-D boxes. Pink: 2-D boxes of what is visible of drawn objects."),
                ],
            ),
            Section(title="Drawn objects", blocks=[objects_table(records)]),
        ),
        footer=tuple((key, str(value)) for key, value in manifest["provenance"].items()),
    )
    write_page(out / "index.html", page)


def draw_truth(
    picture: UInt8[np.ndarray, "height width 3"], frame: SceneFrame, record: Mapping[str, Any]
) -> UInt8[np.ndarray, "height width 3"]:
    """Boxes of the drawn objects over a frame."""
    camera, drawn = frame.camera(), picture
    for truth in truths_of(record):
        if truth.is_drawn and truth.box2d is not None:
            box = truth.box.box()
            drawn = draw_box3d(drawn, type(box)(box.center[0], box.size[0], box.rotation[0]), camera, colour=CYAN)
            drawn = draw_box2d(drawn, truth.box2d, colour=PINK)
    return drawn


def _small(image: UInt8[np.ndarray, "height width 3"]) -> bytes:
    height = max(1, round(image.shape[0] * _WIDTH_PX / image.shape[1]))
    small = np.asarray(cv2.resize(image, (_WIDTH_PX, height), interpolation=cv2.INTER_AREA))
    return encode_jpeg(small, quality=88)


def objects_table(records: Sequence[Mapping[str, Any]]) -> Table:
    """Per drawn track: frames, the distance it covers, how much of it is seen."""
    found: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        for value in record["objects"]:
            if value["is_drawn"]:
                found.setdefault(value["track_id"], []).append(value)
    rows = []
    for track_id, values in found.items():
        depths = [value["box"]["center"][2] for value in values]
        seen = [value for value in values if value["box2d"] is not None]
        hidden = [value["occluded_share"] for value in seen if value["occluded_share"] is not None]
        cells = (
            track_id,
            values[0]["type"],
            str(len(values)),
            f"{min(depths):.1f} to {max(depths):.1f}",
            str(len(seen)),
            f"{100 * float(np.mean(hidden)):.0f} %" if hidden else "-",
        )
        rows.append(tuple(Cell(cell) for cell in cells))
    heads = ("track", "type", "frames", "distance (m)", "frames seen", "hidden, mean")
    return Table("Objects drawn into the photographs", heads, tuple(rows))
