"""2-D boxes, 3-D wireframes and masks drawn on a photo or a patch. Every function returns a new picture.

Positions are px with pixel centres at +0.5, as everywhere; OpenCV's drawing counts from the centre of the first pixel,
so half a pixel is taken off at the door.
"""

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from carstudio.dataset.patch import MaskValue
from carstudio.geometry.box3d import BOX_EDGES, Box3D
from carstudio.geometry.camera import Camera
from carstudio.report.colours import CYAN, GREEN, GREY, ORANGE, PINK, Colour

SUBPIXEL_BITS = 4  # OpenCV's fixed-point positions: 1/16 px
FRONT_FACE = (4, 5, 7, 6)  # corners of `CUBE_CORNERS` with x = +1, in a circle
NEAR_M = 0.1  # edges are cut here, before the projection turns over

Pixels = UInt8[np.ndarray, "height width 3"]


def _fixed(positions: Float[Tensor, "n 2"]) -> np.ndarray:
    """OpenCV's fixed-point integers of image positions; far-away ones are pulled in so that they fit."""
    shifted = (positions.detach().cpu().double().numpy() - 0.5).clip(-1e6, 1e6)
    return np.round(shifted * 2**SUBPIXEL_BITS).astype(np.int32)


def _line(picture: np.ndarray, ends: np.ndarray, colour: Colour, thickness_px: int) -> None:
    start, stop = (tuple(int(value) for value in end) for end in ends)
    cv2.line(picture, start, stop, colour, thickness_px, cv2.LINE_AA, SUBPIXEL_BITS)


def draw_box2d(
    picture: Pixels, box: tuple[float, float, float, float], *, colour: Colour = PINK, thickness_px: int = 1
) -> Pixels:
    """The rectangle x0, y0, x1, y1 (px)."""
    drawn = picture.copy()
    x0, y0, x1, y1 = box
    corners = _fixed(torch.tensor([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], dtype=torch.float64))
    cv2.polylines(drawn, [corners], True, colour, thickness_px, cv2.LINE_AA, SUBPIXEL_BITS)
    return drawn


def visible_edges(box: Box3D, camera: Camera) -> list[tuple[int, int, Float[Tensor, "2 2"]]]:
    """(corner, corner, image positions of the edge's ends) of the edges in front of the camera, cut at `NEAR_M`."""
    corners = box.corners()
    edges = (_project_edge(corners, i, j, camera) for i, j in BOX_EDGES)
    return [edge for edge in edges if edge is not None]


def _project_edge(
    corners: Float[Tensor, "8 3"], i: int, j: int, camera: Camera
) -> tuple[int, int, Float[Tensor, "2 2"]] | None:
    a, b = corners[i], corners[j]
    if a[2] < NEAR_M and b[2] < NEAR_M:
        return None
    if a[2] < NEAR_M:
        a = b + (a - b) * (b[2] - NEAR_M) / (b[2] - a[2])
    elif b[2] < NEAR_M:
        b = a + (b - a) * (a[2] - NEAR_M) / (a[2] - b[2])
    return i, j, camera.project(torch.stack([a, b]))


def faces_camera(box: Box3D) -> bool:
    """Whether the camera lies before the plane of the box's front face, so that the car's front could be seen."""
    forward = box.rotation[:, 0]
    return bool(-(forward @ box.center) > box.size[0] / 2)


def draw_box3d(
    picture: Pixels,
    box: Box3D,
    camera: Camera,
    *,
    colour: Colour = CYAN,
    front_colour: Colour = ORANGE,
    thickness_px: int = 1,
) -> Pixels:
    """The wireframe of a box; its front face is outlined in `front_colour`, crossed, and tinted where it faces us.

    A small patch is better enlarged first (`camera.resize` goes with it): lines are never thinner than a pixel.
    """
    assert picture.shape[:2] == (camera.height, camera.width), "the camera belongs to an image of another size"
    drawn = picture.copy()
    front = box.corners()[list(FRONT_FACE)]
    if bool((front[:, 2] >= NEAR_M).all()):
        positions = _fixed(camera.project(front))
        if faces_camera(box):
            tinted = drawn.copy()
            cv2.fillConvexPoly(tinted, positions, front_colour, cv2.LINE_AA, SUBPIXEL_BITS)
            drawn = cv2.addWeighted(tinted, 0.25, drawn, 0.75, 0)
        _line(drawn, positions[[0, 2]], front_colour, thickness_px)
        _line(drawn, positions[[1, 3]], front_colour, thickness_px)
    for is_front in (False, True):  # the front's edges on top
        for i, j, positions_px in visible_edges(box, camera):
            if (min(i, j) >= 4) is is_front:
                _line(drawn, _fixed(positions_px), front_colour if is_front else colour, thickness_px)
    return drawn


def draw_mask(
    picture: Pixels,
    mask: UInt8[np.ndarray, "height width"],
    *,
    colour: Colour = GREEN,
    unknown_colour: Colour = GREY,
    strength: float = 0.4,
) -> Pixels:
    """Car pixels tinted and outlined, unknown pixels striped."""
    drawn = picture.copy()
    height, width = mask.shape
    stripes = (np.arange(height)[:, None] + np.arange(width)[None, :]) % 6 < 3
    for pixels, tint in (
        (mask == MaskValue.CAR, colour),
        ((mask == MaskValue.UNKNOWN) & stripes, unknown_colour),
    ):
        mixed = drawn[pixels] * (1 - strength) + np.array(tint) * strength
        drawn[pixels] = np.round(mixed).astype(np.uint8)
    outline, _ = cv2.findContours((mask == MaskValue.CAR).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, outline, -1, colour, 1)
    return drawn
