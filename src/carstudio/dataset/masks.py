"""Masks of one photograph's cars: each by the segmenter, then pixels that two cars claim are sorted out.

Where every object has a 3-D box, outlines of nearer ones tell what is hidden. Without one (a detector's boxes) only the
masks of overlapping neighbours can tell: pixels of a nearer vehicle are unknown in the farther one's patch, since the
car may go on behind it; pixels that both claim are unknown in both.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, UInt8

from carstudio.dataset.outlines import core_hulls, crop_window, object_hull, occluder_hulls
from carstudio.dataset.sources.frame import Frame, LabelledObject
from carstudio.errors import InputError
from carstudio.geometry.camera import Camera
from carstudio.perception.results import MaskResult, PhotoSegmenter, Segmenter, SegmentRequest, Window

Pixels = UInt8[np.ndarray, "frame_height frame_width 3"]
Outcome = MaskResult | InputError


def masks_of_frame(
    frame: Frame,
    pixels: Pixels,
    camera: Camera,
    wanted: Sequence[LabelledObject],
    segmenter: Segmenter | PhotoSegmenter,
) -> list[Outcome]:
    """For each wanted object its masks, or why there are none."""
    things = [*wanted, *neighbours(frame, wanted)]
    requests = [_request(frame, thing, pixels, camera) for thing in things]
    outcomes = _segment(requests, segmenter)
    return [_apart(index, things, requests, outcomes) for index in range(len(wanted))]


def neighbours(frame: Frame, wanted: Sequence[LabelledObject]) -> list[LabelledObject]:
    """Objects that are not wanted themselves, but whose masks are needed to sort out those that are."""
    ids = {thing.patch_id for thing in wanted}
    others = [thing for thing in frame.objects if thing.patch_id not in ids]
    return [other for other in others if any(_must_be_sorted_out(thing, other) for thing in wanted)]


def is_nearer(one: LabelledObject, other: LabelledObject) -> bool:
    """By depth where both have a 3-D box, else by where they stand: on level ground, lower in the picture is nearer."""
    if one.box_center is not None and other.box_center is not None:
        return one.box_center[2] < other.box_center[2]
    return one.box2d[3] > other.box2d[3]


def _must_be_sorted_out(one: LabelledObject, other: LabelledObject) -> bool:
    (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = one.box2d, other.box2d
    meet = min(ax1, bx1) > max(ax0, bx0) and min(ay1, by1) > max(ay0, by0)
    return meet and (one.box_center is None or other.box_center is None)


def _request(frame: Frame, thing: LabelledObject, pixels: Pixels, camera: Camera) -> SegmentRequest | InputError:
    height, width = pixels.shape[:2]
    try:
        return SegmentRequest(
            image=pixels,
            window=crop_window(thing.box2d, width, height),
            box2d=thing.box2d,
            hull=object_hull(thing, camera),
            core=core_hulls(thing, camera),
            occluders=occluder_hulls(thing, frame, camera),
            patch_id=thing.patch_id,
            frame_id=frame.frame_id,
            photo_path=frame.image_path,
            truth_mask=thing.truth_mask,
        )
    except InputError as error:
        return error


def _segment(requests: Sequence[SegmentRequest | InputError], segmenter: Segmenter | PhotoSegmenter) -> list[Outcome]:
    good = [request for request in requests if isinstance(request, SegmentRequest)]
    if isinstance(segmenter, PhotoSegmenter):
        try:
            results: list[Outcome] = list(segmenter.segment_all(good)) if good else []
        except InputError as error:
            results = [error] * len(good)
    else:
        results = [_segment_one(request, segmenter) for request in good]
    left = iter(results)
    return [next(left) if isinstance(request, SegmentRequest) else request for request in requests]


def _segment_one(request: SegmentRequest, segmenter: Segmenter) -> Outcome:
    try:
        return segmenter.segment(request)
    except InputError as error:
        return error


def _apart(
    index: int,
    things: Sequence[LabelledObject],
    requests: Sequence[SegmentRequest | InputError],
    outcomes: Sequence[Outcome],
) -> Outcome:
    """The masks of object `index` less what its neighbours claim."""
    request, result = requests[index], outcomes[index]
    if not isinstance(request, SegmentRequest) or not isinstance(result, MaskResult):
        return result
    car, unknown = result.car.copy(), result.unknown.copy()
    for thing, theirs, other in zip(things, requests, outcomes, strict=True):
        if thing is things[index] or not isinstance(theirs, SegmentRequest) or not isinstance(other, MaskResult):
            continue
        if _must_be_sorted_out(things[index], thing):
            claimed = moved(other.car, theirs.window, request.window)
            unknown |= claimed if is_nearer(thing, things[index]) else claimed & result.car
    return MaskResult(car & ~unknown, unknown, result.score)


def moved(
    mask: Bool[np.ndarray, "height width"], window: Window, to: Window
) -> Bool[np.ndarray, "other_height other_width"]:
    """A mask of one window as a mask of another, false outside the first."""
    x0, y0 = max(window.x0, to.x0), max(window.y0, to.y0)
    x1 = min(window.x0 + window.width, to.x0 + to.width)
    y1 = min(window.y0 + window.height, to.y0 + to.height)
    result = np.zeros((to.height, to.width), bool)
    if x1 > x0 and y1 > y0:
        common = Window(x0, y0, x1 - x0, y1 - y0)
        result[common.within(to).slices] = mask[common.within(window).slices]
    return result
