import math

import pytest
import torch

from carstudio.rendering.volume import Rendering
from carstudio.training.losses import (
    LEAST_ERROR,
    USUAL_ERROR,
    LossConfig,
    best_gain,
    colour_error,
    masked_psnr,
    over_photos,
    training_loss,
)


def rendering(rgb: torch.Tensor, opacity: torch.Tensor) -> Rendering:
    return Rendering(rgb, opacity, opacity, opacity, opacity[..., None])


def random_case() -> tuple[tuple[Rendering, ...], torch.Tensor, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    levels = tuple(rendering(torch.rand(2, 5, 3, generator=g), torch.rand(2, 5, generator=g)) for _ in range(2))
    alpha = (torch.rand(2, 5, generator=g) > 0.4).float()
    return levels, torch.rand(2, 5, 3, generator=g), alpha, torch.rand(2, 5, generator=g) > 0.3


@pytest.mark.parametrize("colour", ["masked", "whole-crop"])
def test_loss_equals_the_papers_equations_in_a_loop(colour: str) -> None:
    """Eq. 6-8 ray by ray, the fine level whole and the coarse one at a tenth."""
    levels, rgb, alpha, counts = random_case()
    total, rays = 0.0, int(counts.sum())
    for level, weight in ((levels[0], 0.1), (levels[1], 1.0)):
        for b in range(2):
            for r in range(5):
                if not counts[b, r]:
                    continue
                a = float(alpha[b, r])
                truth = rgb[b, r] if colour == "masked" else a * rgb[b, r]
                square = float(((level.rgb[b, r] - truth) ** 2).mean())
                total += weight * (a * square if colour == "masked" else square) / rays
                total += weight * float((level.opacity[b, r] - a) ** 2) / rays
    terms = training_loss(levels, rgb, alpha, counts, LossConfig(colour=colour))  # type: ignore[arg-type]
    assert float(sum(terms.values())) == pytest.approx(total, rel=1e-5)
    assert set(terms) == {"colour_coarse", "mask_coarse", "colour_fine", "mask_fine"}


def test_the_logarithm_of_a_photos_error_is_its_psnr_on_another_scale() -> None:
    """Far above the least error, ten times the error costs the same from anywhere: 10 dB."""
    errors = torch.tensor([[0.2, 0.4], [2.0, 4.0], [20.0, 40.0]], dtype=torch.float64)
    share = torch.full((1, 2), 0.5, dtype=torch.float64)
    costs = [float(over_photos(row[None], share, "log")) for row in errors]
    expected = USUAL_ERROR * torch.log(torch.tensor(10.0, dtype=torch.float64))
    assert costs[1] - costs[0] == pytest.approx(float(expected), rel=2e-2)
    assert costs[2] - costs[1] == pytest.approx(float(expected), rel=2e-3)


def test_the_logarithm_is_taken_per_photo_by_what_counts_of_it() -> None:
    """Against a loop; the second photo has three of the eight rays that count."""
    levels, rgb, alpha, counts = random_case()
    config = LossConfig(colour="whole-crop", photo_error="log")
    expected = 0.0
    for photo in range(2):
        seen = [
            float(((levels[-1].rgb[photo, r] - alpha[photo, r] * rgb[photo, r]) ** 2).mean())
            for r in range(5)
            if counts[photo, r]
        ]
        if seen:
            expected += len(seen) / int(counts.sum()) * USUAL_ERROR * math.log(1 + sum(seen) / len(seen) / LEAST_ERROR)
    assert float(training_loss(levels, rgb, alpha, counts, config)["colour_fine"]) == pytest.approx(expected, rel=1e-5)
    none = training_loss(levels, rgb, alpha, torch.zeros_like(counts), config)["colour_fine"]
    assert float(none) == 0.0


def test_masked_out_pixels_have_exactly_zero_colour_gradient() -> None:
    rgb = torch.rand(1, 4, 3, requires_grad=True)
    alpha = torch.tensor([[1.0, 0.0, 1.0, 0.0]])
    colour_error(rgb, torch.rand(1, 4, 3), alpha, "masked").sum().backward()
    assert torch.equal(rgb.grad[0, 1], torch.zeros(3))
    assert torch.equal(rgb.grad[0, 3], torch.zeros(3))
    assert float(rgb.grad[0, 0].abs().min()) > 0


def test_unknown_and_missing_rays_take_no_part() -> None:
    levels, rgb, alpha, _ = random_case()
    counts = torch.tensor([[True, False, True, True, True]] * 2)
    before = training_loss(levels, rgb, alpha, counts, LossConfig())
    levels[-1].rgb[:, 1] = 77.0
    levels[0].opacity[:, 1] = -5.0
    after = training_loss(levels, rgb, alpha, counts, LossConfig())
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_without_any_ray_the_loss_is_zero_and_finite() -> None:
    levels, rgb, alpha, _ = random_case()
    terms = training_loss(levels, rgb, alpha, torch.zeros(2, 5, dtype=torch.bool), LossConfig())
    assert float(sum(terms.values())) == 0.0


def test_a_loss_without_silhouette_is_refused() -> None:
    with pytest.raises(AssertionError, match="whole crop"):
        LossConfig(mask_weight=0.0)


def test_psnr_of_a_tenth_is_20_db() -> None:
    truth = torch.full((1, 3, 3), 0.5)
    shown = rendering(truth + torch.tensor([0.1, 0.1, 9.0])[None, :, None], torch.ones(1, 3))
    assert masked_psnr(shown, truth, torch.tensor([[1.0, 1.0, 0.0]])) == pytest.approx(20.0, abs=1e-4)


def test_the_best_gain_is_the_best_of_many_and_forgives_exposure() -> None:
    levels, rgb, alpha, _ = random_case()
    rendered = levels[0].rgb
    gain = best_gain(rendered, rgb, alpha)
    for car in range(2):
        tried = torch.linspace(0.5, 2.0, 1501)
        errors = (alpha[car, :, None] * (rendered[car] * tried[:, None, None] - rgb[car]) ** 2).sum(dim=(1, 2))
        assert float(gain[car]) == pytest.approx(float(tried[errors.argmin()]), abs=1e-3)
    brighter = (rendering(rendered, alpha),)
    everywhere = torch.ones(2, 5, dtype=torch.bool)
    config = LossConfig(exposed_share=1.0)
    assert float(training_loss(brighter, rendered * 1.4, alpha, everywhere, config)["colour_fine"]) < 1e-12
    assert float(training_loss(brighter, rendered * 1.4, alpha, everywhere, LossConfig())["colour_fine"]) > 1e-3
