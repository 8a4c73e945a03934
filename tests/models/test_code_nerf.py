from pathlib import Path

import pytest
import torch

from carstudio.geometry.orbit import orbit_camera
from carstudio.models.autorf import AutoRF, AutoRFConfig
from carstudio.models.car_nerf import CarNeRF, CarNeRFConfig
from carstudio.models.code_nerf import CodeNeRF, CodeNeRFConfig
from carstudio.models.interface import Latents, PatchBatch
from carstudio.models.zoo import build_model, config_from_json, config_to_json, with_cars
from carstudio.recipes import autorf, code_nerf
from carstudio.rendering.cones import Gaussians
from carstudio.rendering.rays import image_rays
from carstudio.training.checkpoint import load_model, save_model
from models.test_pixel_nerf import count, linear, patches, two_views

CARS = ("a", "c", "other")


def model() -> CodeNeRF:
    torch.manual_seed(1)
    return CodeNeRF(CodeNeRFConfig(code_size=16, width=32, cars=CARS)).eval()


def named(*names: str) -> PatchBatch:
    batch = patches(len(names))
    return PatchBatch(batch.image, batch.mask, batch.camera, batch.box, names)


def test_parameter_counts_by_hand() -> None:
    net = CodeNeRF(with_cars(code_nerf().model, tuple("abcdefg")))  # type: ignore[arg-type]
    shape = linear(63, 256) + 3 * (linear(256, 256) + linear(256, 256)) + linear(256, 1)
    colour = linear(256, 256) + linear(256 + 27, 256) + 2 * linear(256, 256) + linear(256, 128) + linear(128, 3)
    assert count(net.field) == shape + colour == 714_756
    assert sum(p.numel() for p in net.code_parameters()) == 2 * 7 * 256
    # N(0, 2 / d): 3,584 draws hold the deviation to about 2.4 %, two standard errors
    assert float(net.shape_codes.detach().std()) == pytest.approx((2 / 256) ** 0.5, rel=0.05)


def test_each_car_has_its_code_and_an_unseen_one_the_mean() -> None:
    net = model()
    found = net.encode(named("c", "nobody"))
    assert torch.equal(found.shape[0], net.shape_codes[1])
    assert torch.equal(found.texture[0], net.texture_codes[1])
    by_hand = sum(net.shape_codes[i] for i in range(3)) / 3
    assert torch.allclose(found.shape[1], by_hand, atol=1e-7)
    assert torch.allclose(found.texture[1], net.texture_codes.mean(dim=0), atol=1e-7)
    assert torch.equal(net.encode(named("c", "a")).shape[1], net.shape_codes[0])


def test_gradients_reach_the_codes_of_the_cars_shown_and_no_others() -> None:
    net, batch = model(), named("c", "a")
    found = net.render(two_views(image_rays(orbit_camera(12))), net.encode(batch), batch.box)
    (found.rgb.sum() + found.opacity.sum()).backward()
    for codes in net.code_parameters():
        assert codes.grad is not None
        rows = codes.grad.abs().amax(dim=1)
        assert float(rows[:2].min()) > 0
        assert float(rows[2]) == 0.0
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert float(parameter.grad.abs().max()) > 0, name


def test_a_codes_gradient_is_the_slope_of_the_picture() -> None:
    net, batch = model().double(), named("c")
    rays = image_rays(orbit_camera(6))
    rays = type(rays)(*(getattr(rays, name).double() for name in rays.__annotations__))
    box = type(batch.box)(*(getattr(batch.box, name).double() for name in ("center", "size", "rotation")))
    start = net.encode(batch)

    def brightness(shape: torch.Tensor) -> torch.Tensor:
        return net.render(rays, Latents(shape, start.texture), box).rgb.sum()

    code = start.shape.detach().requires_grad_()
    brightness(code).backward()
    step = torch.zeros_like(code)
    step[0, 3] = 1e-4
    with torch.no_grad():
        slope = float(brightness(code + step) - brightness(code - step)) / 2e-4
    assert code.grad is not None
    # the field's last layers are float32 by design (autocast), so the difference quotient is good to a per cent
    assert float(code.grad[0, 3]) == pytest.approx(slope, rel=0.02, abs=1e-4)


def test_texture_leaves_density_bit_identical() -> None:
    net, batch = model(), named("a")
    rays = image_rays(orbit_camera(12))
    with torch.no_grad():
        latents = net.encode(batch)
        a = net.trace(rays, latents, batch.box)
        b = net.trace(rays, Latents(latents.shape, latents.texture + 3), batch.box)
    assert torch.equal(a.alpha, b.alpha)
    assert not torch.allclose(a.rgb, b.rgb)


def test_the_cars_are_in_the_model_file(tmp_path: Path) -> None:
    net = model()
    save_model(tmp_path, net, net.config, {})
    again = load_model(tmp_path)
    assert config_from_json(config_to_json(net.config), name="it") == net.config
    assert torch.equal(again.encode(named("other")).shape, net.encode(named("other")).shape)
    assert with_cars(CarNeRFConfig(), ("x",)) == CarNeRFConfig()


def test_autorf_is_its_own_sizes_over_points() -> None:
    with torch.device("meta"):
        net = AutoRF(autorf().model)
        assert type(build_model(autorf().model)) is AutoRF
        assert type(build_model(CarNeRFConfig())) is CarNeRF
    into = linear(60, 128) + linear(128, 128)
    colour = linear(128, 128) + linear(128, 128) + linear(24, 128) + linear(128, 64) + linear(64, 3)
    assert count(net.field) == 2 * into + 7 * linear(128, 128) + linear(128, 1) + colour == 209_028
    assert (net.sampling.coarse, net.sampling.fine) == (64, 0)


def test_autorf_does_not_see_how_wide_a_cone_is() -> None:
    """And Car-NeRF does; both encode the same where a cone has no width."""
    torch.manual_seed(0)
    point = CarNeRF(AutoRFConfig(width=32, depth=3, skip_after=None)).field
    cone = CarNeRF(CarNeRFConfig(width=32, depth=3, skip_after=None, position_frequencies=10)).field
    mean, nothing = torch.rand(1, 2, 3, 3) - 0.5, torch.zeros(1, 2, 3, 3)
    thin, wide = Gaussians(mean, nothing), Gaussians(mean, nothing + 0.05)
    assert torch.equal(point._encode_position(thin), point._encode_position(wide))
    assert not torch.allclose(cone._encode_position(thin), cone._encode_position(wide))
    assert torch.allclose(cone._encode_position(thin), point._encode_position(thin), atol=1e-6)
