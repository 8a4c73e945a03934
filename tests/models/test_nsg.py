"""NSG's object model: its size by hand, what its colour and density may know, and the enlarged box."""

import torch

from carstudio.geometry.box3d import Box3D, box_from_kitti
from carstudio.geometry.camera import Camera
from carstudio.models.interface import Latents, PatchBatch
from carstudio.models.nsg import NSG, NSGConfig
from carstudio.models.zoo import build_model, config_from_json, config_to_json, with_cars
from carstudio.rendering.field import SamplingConfig
from carstudio.rendering.rays import Rays, image_rays

SMALL = NSGConfig(sampling=SamplingConfig(coarse=6, fine=0), code_size=5, width=16, depth=4, cars=("a", "b"))


def box(x: float = 0.5) -> Box3D:
    return box_from_kitti(torch.tensor([[x, 1.2, 8.0]]), torch.tensor([[4.0, 1.5, 1.8]]), torch.tensor([0.4]))


def test_parameters_by_hand() -> None:
    """D = 8, W = 256, 10 and 4 octaves, a code of 256 beside the position, which enters again in the middle."""
    model = NSG(NSGConfig(cars=("a", "b", "c")))
    entry, seen = 3 + 6 * 10 + 256, 3 + 6 * 4
    trunk = (entry + 1) * 256 + 6 * (256 + 1) * 256 + (256 + entry + 1) * 256
    heads = (256 + 1) + (256 + 1) * 256 + (256 + 2 * seen + 1) * 128 + (128 + 1) * 3
    assert sum(parameter.numel() for parameter in model.parameters()) == 3 * 256 + trunk + heads


def test_codes_belong_to_cars_and_strangers_are_the_mean() -> None:
    torch.manual_seed(0)
    model = build_model(with_cars(SMALL, ("a", "b")))
    camera = Camera(torch.ones(3, 4), 8, 8)
    batch = PatchBatch(torch.zeros(3, 3, 8, 8), torch.zeros(3, 8, 8), camera, box(), ("b", "a", "who"))
    latents = model.encode(batch)
    (codes,) = model.code_parameters()
    assert torch.equal(latents.shape, torch.stack([codes[1], codes[0], codes.mean(0)]))
    assert latents.texture.shape == (3, 0)
    assert config_from_json(config_to_json(SMALL), name="here") == SMALL


def test_the_place_reaches_colours_and_nothing_else() -> None:
    torch.manual_seed(1)
    for sees_place in (True, False):
        model = NSG(NSGConfig(sampling=SMALL.sampling, code_size=5, width=16, depth=4, sees_place=sees_place))
        points, views = torch.rand(1, 3, 6, 3), torch.nn.functional.normalize(torch.rand(1, 3, 3), dim=-1)
        code = torch.rand(1, 5)
        if not sees_place:
            found = [model.field(points, views, code, place) for place in (torch.zeros(1, 3), torch.ones(1, 3))]
            assert torch.equal(found[0][1], found[1][1])
            continue
        here, there = (model.field(points, views, code, place) for place in (torch.zeros(1, 3), torch.ones(1, 3)))
        assert torch.equal(here[0], there[0])
        assert not torch.equal(here[1], there[1])


def test_samples_are_spread_over_the_enlarged_box() -> None:
    """Against intersections by hand: from before a box 1.9 times as long to behind it, seven even steps."""
    torch.manual_seed(2)
    model = NSG(NSGConfig(sampling=SamplingConfig(coarse=7, fine=0), code_size=5, width=16, depth=4))
    straight = Box3D(torch.tensor([[0.0, 0.0, 10.0]]), torch.tensor([[4.0, 1.5, 2.0]]), torch.eye(3)[None])
    rays = Rays(torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, 1.0]]]), torch.full((1, 1), 1e-3))
    latents = Latents(torch.rand(1, 5), torch.zeros(1, 0))
    segments = model.trace(rays, latents, straight)
    half = 2.0 * 1.9 / 2
    edges = torch.linspace(10 - half, 10 + half, 8)
    torch.testing.assert_close(segments.distance_m[0, 0], (edges[1:] + edges[:-1]) / 2, rtol=0, atol=2e-2)
    beside = Rays(
        torch.zeros(1, 1, 3), torch.nn.functional.normalize(torch.tensor([[[3.5, 0.0, 10.0]]]), dim=-1), rays.radii
    )
    assert float(model.trace(beside, latents, straight).alpha.detach().max()) > 0, (
        "beside the car, inside the enlarged box"
    )


def test_it_learns_a_colour() -> None:
    torch.manual_seed(3)
    model = build_model(SMALL)
    rays = image_rays(Camera(torch.tensor([20.0, 20.0, 8.0, 6.0]), 16, 12))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    wanted = torch.tensor([0.9, 0.2, 0.1])
    losses = []
    for _ in range(60):
        (codes,) = model.code_parameters()
        found = model.render(rays, Latents(codes[:1], codes[:1, :0]), box())
        inside = found.opacity.detach() > 0
        loss = (found.rgb - wanted)[inside].square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.2 * losses[0]
