"""Which photographs show a track's car best, and the patches cut from them."""

import math
from dataclasses import dataclass, replace

import torch

from carstudio.dataset.candidates import records_of_frame
from carstudio.dataset.filters import FilterRecipe, judge
from carstudio.dataset.patch import PatchRecord
from carstudio.dataset.sources.frame import Frame
from carstudio.errors import InputError
from carstudio.geometry.box3d import envelope
from carstudio.geometry.orbit import viewing_angles
from carstudio.perception.results import PhotoSegmenter, Segmenter
from carstudio.scene.graph import Scene, Track
from carstudio.scene.kitti import Log

# Share of a car that is taken to be seen at KITTI's occlusion levels (visible, partly, largely): for ranking.
_SEEN = {0: 1.0, 1: 0.5, 2: 0.2, None: 0.7}
_SPREAD_RAD = math.radians(30)  # views farther apart than this count as different


@dataclass(frozen=True)
class ViewConfig:
    """Which photographs of a car are taken; smaller cars than the released thresholds allow still give a colour."""

    views: int = 8
    """Most photographs that a car is fitted to."""
    height_px: float = 32.0
    """Least height of the car in the photograph, px."""
    depth_m: float = 50.0
    """Greatest distance along the camera's axis, m."""
    mask_ratio: float = 0.4
    """Least share of the 2-D box that is car."""

    def __post_init__(self) -> None:
        if self.views < 1:
            raise InputError(f"--views must be at least 1, found {self.views}")

    def filters(self, type_: str) -> FilterRecipe:
        """The build's filters at these thresholds."""
        return FilterRecipe(
            types=(type_,),
            height_px=self.height_px,
            width_px=self.height_px / 2,
            depth_m=self.depth_m,
            mask_ratio=self.mask_ratio,
            box_iou=0.4,
        )


@dataclass(frozen=True)
class View:
    """One photograph of a car: `quality` grows with the pixels that show it; `azimuth_rad` as `viewing_angles`."""

    frame: int
    quality: float
    azimuth_rad: float


def rank_views(scene: Scene, track: Track, config: ViewConfig) -> list[View]:
    """A track's views in the order they are worth taking: many visible pixels, from different sides.

    Only views whose box is before the camera, near and large enough. Empty when there are none.
    """
    candidates = [view for view in (_view(scene, track, index, config) for index in sorted(track.boxes)) if view]
    chosen: list[View] = []
    while candidates:
        best = max(candidates, key=lambda view: (view.quality * _novelty(view, chosen), -view.frame))
        chosen.append(best)
        candidates.remove(best)
    return chosen


def _view(scene: Scene, track: Track, index: int, config: ViewConfig) -> View | None:
    box, camera = track.boxes[index].box(), scene.frame(index).camera()
    single = replace(box, center=box.center[0], size=box.size[0], rotation=box.rotation[0])
    outline, whole = envelope(single, camera), envelope(single, camera, clip=False)
    depth = float(single.center[2])
    if outline is None or whole is None or not 0 < depth <= config.depth_m:
        return None
    if float(outline[3] - outline[1]) < config.height_px:
        return None
    in_sight = float((outline[2:] - outline[:2]).prod())
    share = in_sight / max(float((whole[2:] - whole[:2]).prod()), 1.0)
    seen = _SEEN.get(track.labels.get(index, {}).get("occlusion"), 0.7)
    azimuth, _ = viewing_angles(single)
    return View(index, in_sight * share * seen, float(azimuth))


def _novelty(view: View, chosen: list[View]) -> float:
    """1 for a view from a new side, 0.25 for the side of one that was taken already."""
    if not chosen:
        return 1.0
    apart = min(abs(math.remainder(view.azimuth_rad - other.azimuth_rad, 2 * math.pi)) for other in chosen)
    return 0.25 + 0.75 * min(apart / _SPREAD_RAD, 1.0)


def patches_of_track(
    log: Log, track: Track, segmenter: Segmenter | PhotoSegmenter, config: ViewConfig
) -> tuple[list[PatchRecord], list[str]]:
    """Patches of a track's best views with masks that pass the filters, best first; and what was wrong with others."""
    ranked = rank_views(log.scene, track, config)
    records: list[PatchRecord] = []
    problems: list[str] = []
    for view in ranked[: 2 * config.views]:
        if len(records) == config.views:
            break
        try:
            record = patch_in_frame(log, log.source.load(log.refs[view.frame]), track, segmenter)
        except InputError as error:
            problems.append(f"frame {view.frame}: {error}")
            continue
        verdict = judge(record, config.filters(track.type))
        if verdict.is_kept:
            records.append(record)
        else:
            problems.append(f"frame {view.frame}: rejected by {verdict.reason}")
    if not ranked:
        problems.append(f"no view of at least {config.height_px:g} px within {config.depth_m:g} m")
    return records, problems


def patch_in_frame(log: Log, frame: Frame, track: Track, segmenter: Segmenter | PhotoSegmenter) -> PatchRecord:
    """The patch of one track in one loaded frame; `InputError` when there is none."""
    others = frozenset(thing.patch_id for thing in frame.objects if log.track_of(frame, thing) != track.track_id)
    found = records_of_frame(
        frame,
        segmenter,
        source=log.source.name,
        licence=log.source.licence,
        types=(track.type,),
        done=others,
    )
    if not found.records:
        raise InputError("; ".join(found.problems) or "the track is not in this frame")
    return found.records[0]


def psnr_on_car(rendered: torch.Tensor, truth: torch.Tensor, mask: torch.Tensor) -> float | None:
    """PSNR (dB) of two pictures in [0, 1] over the mask's pixels; None without any."""
    if not bool(mask.any()):
        return None
    error = float(((rendered - truth)[mask] ** 2).mean())
    return round(-10 * math.log10(max(error, 1e-10)), 3)
