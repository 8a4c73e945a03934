"""Boxes that give way: what each number does to the picture, its bounds, and a pose that is found again."""

import dataclasses
import math

import pytest
import torch

import carstudio
from carstudio.errors import InputError
from carstudio.fitting.boxes import BoxFreedom, BoxMoves, across, moved_boxes, prior_of, shortest_rotation
from carstudio.fitting.optimise import FitConfig, FitPixels, fit
from carstudio.geometry.box3d import Box3D, box_from_kitti
from carstudio.geometry.camera import Camera
from carstudio.rendering.rays import image_rays
from carstudio.rendering.volume import Rendering
from models.codes import mean_latents

CAMERA = Camera(torch.tensor([700.0, 700.0, 600.0, 180.0]), 1242, 375)
ALL = BoxFreedom(refine_pose=True, refine_size=True)


def boxes() -> Box3D:
    """Two photographs of one car and one of another."""
    bottom = torch.tensor([[-4.0, 1.7, 9.0], [2.0, 1.6, 14.0], [0.5, 1.5, 7.0]])
    size = torch.tensor([[4.2, 1.5, 1.8], [4.2, 1.5, 1.8], [3.6, 1.4, 1.6]])
    return box_from_kitti(bottom, size, torch.tensor([0.4, -1.3, 2.9]))


CARS = torch.tensor([0, 0, 1])


def moves(photo: dict[int, float] | None = None, car: dict[int, float] | None = None) -> BoxMoves:
    none = BoxMoves.none(3, 2, torch.zeros(()))
    for index, value in (photo or {}).items():
        none.photo[:, index] = value
    for index, value in (car or {}).items():
        none.car[:, index] = value
    return none


def pictured(box: Box3D) -> torch.Tensor:
    return CAMERA.project(box.corners())


def test_no_move_leaves_the_boxes() -> None:
    found = moved_boxes(boxes(), CARS, moves(), ALL)
    for name in ("center", "size", "rotation"):
        torch.testing.assert_close(getattr(found, name), getattr(boxes(), name), rtol=1e-6, atol=1e-6)


def test_a_car_that_grows_moves_away_and_looks_the_same() -> None:
    found = moved_boxes(boxes(), CARS, moves(car={0: 0.6, 1: 0.6, 2: 0.6}), ALL)
    grown = math.exp(ALL.most_side * math.tanh(0.6))
    torch.testing.assert_close(found.size, boxes().size * grown)
    torch.testing.assert_close(pictured(found), pictured(boxes()), rtol=0, atol=2e-3)
    alone = moved_boxes(boxes(), CARS, moves(car={0: 0.6}), BoxFreedom(refine_size=True))
    assert torch.equal(alone.center, boxes().center)
    torch.testing.assert_close(alone.size[:, 0], boxes().size[:, 0] * grown)
    assert torch.equal(alone.size[:, 1:], boxes().size[:, 1:])


def test_apparent_size_and_shift_do_to_the_picture_what_they_say() -> None:
    """Against pixels: a small car seen square on grows by the factor and shifts by the share of its length."""
    box = Box3D(torch.tensor([[0.0, 0.0, 40.0]]), torch.tensor([[1.0, 1.0, 1e-3]]), torch.eye(3)[None])
    one = torch.zeros(1, dtype=torch.long)

    def picture(photo: list[float]) -> torch.Tensor:
        given = BoxMoves(torch.tensor([photo]), torch.zeros(1, 3))
        return pictured(moved_boxes(box, one, given, ALL))[0]

    before, larger = picture([0.0] * 6), picture([0.0] * 5 + [50.0])
    width = float(before[:, 0].max() - before[:, 0].min())
    ratio = float(larger[:, 0].max() - larger[:, 0].min()) / width
    assert ratio == pytest.approx(math.exp(ALL.most_apparent), rel=1e-3)
    right, down = picture([50.0] + [0.0] * 5), picture([0.0, 50.0] + [0.0] * 4)
    torch.testing.assert_close(
        right - before, torch.tensor([ALL.most_shift * width, 0.0]).expand(8, 2), rtol=0, atol=2e-2
    )
    torch.testing.assert_close(
        down - before, torch.tensor([0.0, ALL.most_shift * width]).expand(8, 2), rtol=0, atol=2e-2
    )


def test_nothing_leaves_its_bounds() -> None:
    torch.manual_seed(0)
    wild = BoxMoves(100 * torch.randn(3, 6), 100 * torch.randn(2, 3))
    found, given = moved_boxes(boxes(), CARS, wild, ALL), boxes()
    assert float((found.size / given.size).log().abs().max()) <= ALL.most_side + 1e-6
    far = (found.center.norm(dim=-1) / given.center.norm(dim=-1)).log().abs()
    assert float(far.max()) <= ALL.most_apparent + ALL.most_side + 1e-6
    seen = shortest_rotation(*(torch.nn.functional.normalize(b.center, dim=-1) for b in (given, found)))
    turned = given.rotation.mT @ seen.mT @ found.rotation
    angle = torch.rad2deg(torch.arccos(((turned.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)))
    assert float(angle.max()) <= ALL.most_turn_deg * 3**0.5 + 1e-3
    torch.testing.assert_close(found.rotation @ found.rotation.mT, torch.eye(3).expand(3, 3, 3), rtol=0, atol=1e-5)
    assert torch.equal(found.size[0], found.size[1]), "one car has one size"
    assert float(prior_of(wild, ALL)) <= ALL.box_prior * (18 + 6)


def test_lines_of_sight_turn_the_shortest_way() -> None:
    torch.manual_seed(1)
    a, b = torch.nn.functional.normalize(torch.randn(2, 50, 3).double(), dim=-1)
    found = shortest_rotation(a, b)
    torch.testing.assert_close((found @ a[..., None])[..., 0], b)
    angle = torch.arccos(((found.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    torch.testing.assert_close(angle, torch.arccos((a * b).sum(-1)), rtol=1e-5, atol=1e-6)
    right, down = across(torch.tensor([[0.0, 0.0, 1.0]]))
    assert torch.equal(right, torch.tensor([[1.0, 0.0, 0.0]]))
    assert torch.equal(down, torch.tensor([[0.0, 1.0, 0.0]]))


def test_a_wrong_pose_is_found_again() -> None:
    """A car drawn at its true box, told a wrong one: shift, turn and apparent size come back from the pixels."""
    model = carstudio.load_model("car-gaussians")
    latents = mean_latents(model)
    true = box_from_kitti(torch.tensor([[0.6, 1.3, 8.0]]), torch.tensor([[4.2, 1.5, 1.8]]), torch.tensor([0.7]))
    one = torch.zeros(1, dtype=torch.long)
    wrong_by = BoxMoves(torch.tensor([[0.5, -0.4, 0.1, 0.6, -0.1, 0.5]]), torch.zeros(1, 3))
    wrong = moved_boxes(true, one, wrong_by, ALL)
    rays = image_rays(Camera(torch.tensor([100.0, 100.0, 45.0, 36.0]), 96, 64))
    with torch.no_grad():
        seen = model.render(rays, latents, true)
    assert float(seen.opacity.mean()) > 0.1

    def draw(step: int) -> FitPixels:
        every = torch.ones_like(seen.opacity, dtype=torch.bool)
        return FitPixels(rays, wrong, seen.rgb, seen.opacity, every, one)

    def objective(renderings: tuple[Rendering, ...], pixels: FitPixels) -> torch.Tensor:
        found = renderings[-1]
        return (found.rgb - pixels.rgb).square().mean() + (found.opacity - pixels.alpha).square().mean()

    freedom = BoxFreedom(refine_pose=True, box_rate=0.05, box_prior=0.0)
    found = fit(model, latents, draw, objective, FitConfig(steps=60, latent_rate=0.0, box=freedom))
    assert found.box is not None
    assert torch.equal(found.latents.shape, latents.shape)

    def errors(box: Box3D) -> tuple[float, float, float]:
        between = box.rotation.mT @ true.rotation
        angle = math.degrees(math.acos(min(1.0, (float(between[0].trace()) - 1) / 2)))
        return (
            float((pictured(box) - pictured(true)).norm(dim=-1).mean()),
            angle,
            float((box.center - true.center).norm()),
        )

    for before, after in zip(errors(wrong), errors(found.box), strict=True):
        assert after < 0.25 * before, (errors(wrong), errors(found.box))


@pytest.mark.parametrize(
    "wrong",
    [{"most_shift": -0.1}, {"most_side": 2.0}, {"most_turn_deg": 90.0}, {"box_rate": -1.0}, {"box_prior": -1.0}],
)
def test_absurd_bounds_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="box freedom"):
        dataclasses.replace(BoxFreedom(), **wrong)
