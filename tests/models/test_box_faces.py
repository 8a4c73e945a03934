"""Photos laid out on the faces of the box: against planes painted by rays, mirrored photos, what is out of sight."""

import dataclasses
from typing import Literal

import pytest
import torch
from torch import Tensor

from carstudio.geometry.box3d import Box3D, mirror_box
from carstudio.geometry.camera import Camera
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.box_faces import CHANNELS, PLANE, box_faces
from carstudio.models.encoders import EncoderConfig, build_encoder
from carstudio.models.interface import PatchBatch
from carstudio.rendering.rays import image_rays, to_canonical

SIDE = 32
SIZE = torch.tensor([4.2, 1.5, 1.8])


def photo(image: Tensor, azimuth_deg: float, *, elevation_deg: float = 8.0, mask: Tensor | None = None) -> PatchBatch:
    """One picture (3 side side) of a car on an orbit, the mask full unless given."""
    side = image.shape[-1]
    box = orbit_box(SIZE, azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, distance_m=9.0)
    camera = Camera(orbit_camera(side).intrinsics[None], side, side)
    boxes = Box3D(box.center[None], box.size[None], box.rotation[None])
    return PatchBatch(image[None], torch.ones(1, side, side) if mask is None else mask[None], camera, boxes, ("a",))


def painted(azimuth_deg: float, axis: int, sign: float, side: int = 256) -> PatchBatch:
    """A photo of one plane, axis = sign * PLANE, each point coloured by where it is: (x, y, z) / 4 + 1/2, canonical."""
    empty = photo(torch.zeros(3, side, side), azimuth_deg)
    rays = image_rays(orbit_camera(side))
    canonical = to_canonical(rays, empty.box)
    origin, toward = canonical.origins, canonical.view_directions
    t = (sign * PLANE - origin[..., axis]) / toward[..., axis]
    point = origin + t[..., None] * toward
    colour = (point / 4 + 0.5).clamp(0, 1).reshape(1, side, side, 3).permute(0, 3, 1, 2)
    return dataclasses.replace(empty, image=colour)


def eye_of(patches: PatchBatch) -> Tensor:
    """The camera's place, canonical, from the rays it casts."""
    return to_canonical(image_rays(orbit_camera(4)), patches.box).origins[0, 0]


@pytest.mark.parametrize("azimuth_deg", [25.0, 70.0, 115.0, 160.0, 205.0, 250.0, 290.0, 340.0])
def test_each_pixel_shows_its_place_on_the_face(azimuth_deg: float) -> None:
    """The painted colour read back is the place: an oracle that projects nothing, it only cuts rays with a plane."""
    eye = eye_of(photo(torch.zeros(3, SIDE, SIDE), azimuth_deg))
    near = 1.0 if eye[2] > 0 else -1.0
    half = SIDE // 2
    middles = (2 * torch.arange(SIDE) + 1) / SIDE - 1
    coarse = (2 * torch.arange(half) + 1) / half - 1
    side = box_faces(painted(azimuth_deg, 2, near), SIDE)[0, :, :half]
    is_seen = side[4] > 0.999
    assert float(is_seen.float().mean()) > 0.9
    place = 2 * side[:3]  # rgb in [-1, 1] is x / 2
    for found, expected in (
        (place[0], middles.expand(half, SIDE)),
        (place[1], coarse[:, None].expand(half, SIDE)),
        (place[2], torch.full((half, SIDE), near * PLANE)),
    ):
        assert float((found - expected)[is_seen].abs().max()) < 0.02
    end = 1.0 if eye[0] > 0 else -1.0
    if abs(float(eye[0])) < 1.2:
        return  # the camera stands almost in the plane
    ends = box_faces(painted(azimuth_deg, 0, end), SIDE)[0, :, half:]
    shown, hidden = (ends[..., :half], ends[..., half:]) if end > 0 else (ends[..., half:], ends[..., :half])
    is_seen = shown[4] > 0.999
    assert float(is_seen.float().mean()) > 0.9
    place = 2 * shown[:3]
    for found, expected in (
        (place[0], torch.full((half, half), end * PLANE)),
        (place[1], coarse[:, None].expand(half, half)),
        (place[2], near * coarse.expand(half, half)),
    ):
        assert float((found - expected)[is_seen].abs().max()) < 0.02
    assert float(hidden.abs().max()) == 0


@pytest.mark.parametrize("azimuth_deg", [20.0, 100.0, 230.0, 310.0])
def test_a_mirrored_photo_gives_the_same_faces(azimuth_deg: float) -> None:
    """The side that is seen is turned to one way round, so a car and its mirror image look alike."""
    torch.manual_seed(0)
    plain = photo(torch.rand(3, 64, 64), azimuth_deg, mask=torch.rand(64, 64))
    flipped = dataclasses.replace(
        plain,
        image=plain.image.flip(3),
        mask=plain.mask.flip(2),
        camera=plain.camera.flip(),
        box=mirror_box(plain.box),
    )
    torch.testing.assert_close(box_faces(flipped, SIDE), box_faces(plain, SIDE), atol=2e-4, rtol=0)


def test_the_mask_and_what_lies_beyond_the_photo() -> None:
    image, mask = torch.full((3, 64, 64), 0.75), torch.zeros(64, 64)
    mask[:, :32] = 1
    near = photo(image, 90.0, mask=mask)
    close = dataclasses.replace(near, box=dataclasses.replace(near.box, center=near.box.center * 0.3))
    for patches in (near, close):
        faces = box_faces(patches, SIDE)[0]
        assert faces.shape == (CHANNELS, SIDE, SIDE)
        torch.testing.assert_close(faces[:3], 0.5 * faces[4:].expand(3, -1, -1))  # rgb is 0 where nothing is seen
        assert bool((faces[3] <= faces[4] + 1e-6).all())
        assert 0 < float(faces[3].sum()) < float(faces[4].sum())
    assert float(box_faces(close, SIDE)[0, 4].sum()) < float(box_faces(near, SIDE)[0, 4].sum())


def test_a_camera_inside_the_box_sees_nothing() -> None:
    inside = photo(torch.rand(3, 64, 64), 40.0)
    inside = dataclasses.replace(inside, box=dataclasses.replace(inside.box, center=torch.zeros(1, 3)))
    assert float(box_faces(inside, SIDE).abs().max()) == 0


@torch.no_grad()
@pytest.mark.parametrize("stem_px", [2, 4])
def test_its_encoder_tells_cars_apart_and_not_their_mirror_images(stem_px: Literal[2, 4]) -> None:
    torch.manual_seed(0)
    encoder = build_encoder(
        EncoderConfig("box-faces", side_px=32, pretrained=None, num_features=48, sees_mask=True, stem_px=stem_px)
    )
    one, other = photo(torch.rand(3, 32, 32), 35.0), photo(torch.rand(3, 32, 32), 35.0)
    assert encoder(one).shape == (1, 48)
    assert not torch.allclose(encoder(one), encoder(other), atol=1e-3)
    flipped = dataclasses.replace(
        one, image=one.image.flip(3), mask=one.mask.flip(2), camera=one.camera.flip(), box=mirror_box(one.box)
    )
    torch.testing.assert_close(encoder(flipped), encoder(one), atol=1e-4, rtol=0)


@pytest.mark.parametrize("changes", [{"sees_mask": False}, {"side_px": 40}])
def test_sizes_it_cannot_have(changes: dict[str, object]) -> None:
    with pytest.raises(AssertionError, match="box-faces"):
        EncoderConfig(**{"kind": "box-faces", "side_px": 64, "num_features": 8, "sees_mask": True, **changes})  # type: ignore[arg-type]
