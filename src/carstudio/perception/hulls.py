"""Convex outlines in the image and the pixels they cover."""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from carstudio.perception.results import SegmentRequest, Window


def convex_hull(points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Corners of the convex hull in order around it (px)."""
    if len(points) < 3:
        return points
    order = cv2.convexHull(points.astype(np.float32), returnPoints=False)[:, 0]
    return points[order]


def fill_hull(hull: Float[np.ndarray, "n 2"], window: Window) -> Bool[np.ndarray, "height width"]:
    """Pixels of the window whose centre lies in the convex outline; either direction around it."""
    inside = np.ones((window.height, window.width), bool)
    if len(hull) < 3:
        return ~inside
    u = window.x0 + np.arange(window.width) + 0.5
    v = (window.y0 + np.arange(window.height) + 0.5)[:, None]
    nxt = np.roll(hull, -1, axis=0)
    area = float((hull[:, 0] * nxt[:, 1] - hull[:, 1] * nxt[:, 0]).sum())
    for (x0, y0), (x1, y1) in zip(hull, nxt, strict=True):
        inside &= ((x1 - x0) * (v - y0) - (y1 - y0) * (u - x0)) * np.sign(area) >= 0
    return inside


def outline(request: SegmentRequest) -> Float[np.ndarray, "n 2"]:
    """The projected outline of the car's 3-D box, or its 2-D box when there is none."""
    if request.hull is not None:
        return request.hull
    x0, y0, x1, y1 = request.box2d
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], np.float64)


def shrink(hull: Float[np.ndarray, "n 2"], factor: float) -> Float[np.ndarray, "n 2"]:
    """The outline scaled about the centre of its bounding box."""
    center = (hull.min(axis=0) + hull.max(axis=0)) / 2
    return center + (hull - center) * factor


def visible_height_px(request: SegmentRequest) -> float:
    """Height of the 2-D box inside the photograph: a label may claim a box of any size."""
    return min(request.box2d[3], float(request.image.shape[0])) - max(request.box2d[1], 0.0)


def occluded_pixels(request: SegmentRequest, window: Window) -> Bool[np.ndarray, "height width"]:
    """Pixels of the window inside the outline of a nearer object: the car may or may not be seen there."""
    occluded = np.zeros((window.height, window.width), bool)
    for hull in request.occluders:
        occluded |= fill_hull(hull, window)
    return occluded


def allowed_pixels(request: SegmentRequest, margin_px: float, window: Window) -> Bool[np.ndarray, "height width"]:
    """Pixels that can be of this car: inside its outline (3-D box, else 2-D box) widened by `margin_px`."""
    inside = fill_hull(outline(request), window)
    if margin_px < 1:
        return inside
    size = 2 * round(margin_px) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(inside.astype(np.uint8), kernel).astype(bool)


def enlarged_window(request: SegmentRequest, factor: float) -> Window:
    """The 2-D box scaled about its centre, as whole pixels inside the photograph; always contains the crop."""
    x0, y0, x1, y1 = request.box2d
    half_width, half_height = (x1 - x0) * factor / 2, (y1 - y0) * factor / 2
    height, width = request.image.shape[:2]
    window = request.window
    left = max(0, min(math.floor((x0 + x1) / 2 - half_width), window.x0))
    top = max(0, min(math.floor((y0 + y1) / 2 - half_height), window.y0))
    right = min(width, max(math.ceil((x0 + x1) / 2 + half_width), window.x0 + window.width))
    bottom = min(height, max(math.ceil((y0 + y1) / 2 + half_height), window.y0 + window.height))
    return Window(left, top, right - left, bottom - top)


def clean_mask(car: Bool[np.ndarray, "height width"], least_share: float = 0.1) -> Bool[np.ndarray, "height width"]:
    """The mask without specks and pinholes: parts and holes smaller than `least_share` of its largest part.

    Larger ones stay: a post in front cuts a car in two, and one sees through under a bumper.
    """
    sizes = _part_sizes(car)
    if not car.any():
        return car
    least = least_share * float(sizes[car].max())
    car = car & (sizes >= least)
    return car | (~car & (_part_sizes(~car) < least) & ~_touches_border(~car))


def _part_sizes(mask: Bool[np.ndarray, "height width"]) -> Shaped[np.ndarray, "height width"]:
    """Each pixel's number of pixels in its 4-connected part of the mask, 0 outside."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    sizes = stats[:, cv2.CC_STAT_AREA]
    sizes[0] = 0
    return sizes[labels]


def _touches_border(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Pixels of parts that reach the edge of the image."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    edge = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, edge) & mask
