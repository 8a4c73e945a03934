"""PSNR, SSIM, IoU: against skimage, scipy, slow loops and by invariance."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from carstudio.dataset.patch import MaskValue
from carstudio.evaluation.metrics import (
    PSNR_CAP_DB,
    psnr,
    psnr_mask,
    score_image,
    ssim,
    ssim_map,
    ssim_mask,
)
from carstudio.evaluation.perceptual import Lpips, load_lpips

SIZES = [(11, 11), (12, 40), (37, 64), (128, 128)]


def picture_pair(height, width, seed=0, noise=0.1, dtype=torch.float64):
    """A smooth picture and a disturbed copy, so that SSIM is far from both 0 and 1."""
    generator = np.random.default_rng(seed)
    truth = gaussian_filter(generator.random((height, width, 3)), (2, 2, 0))
    truth = (truth - truth.min()) / (truth.max() - truth.min())
    image = np.clip(truth + noise * generator.standard_normal(truth.shape), 0, 1)
    return torch.tensor(image, dtype=dtype), torch.tensor(truth, dtype=dtype)


def skimage_ssim(image, truth, **options):
    return structural_similarity(
        image.numpy(), truth.numpy(), gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=-1, **options,
    )  # fmt: skip


@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_psnr_and_ssim_agree_with_skimage(height, width, dtype):
    image, truth = picture_pair(height, width, dtype=dtype)
    expected_psnr = peak_signal_noise_ratio(truth.double().numpy(), image.double().numpy(), data_range=1.0)
    assert float(psnr(image, truth)) == pytest.approx(expected_psnr, abs=1e-4)  # float32 rounding of the mean
    assert float(ssim(image, truth)) == pytest.approx(skimage_ssim(image.double(), truth.double()), abs=1e-5)


def test_ssim_map_is_skimages_full_map_up_to_the_edge():
    image, truth = picture_pair(23, 31)
    _, full = skimage_ssim(image, truth, full=True)
    np.testing.assert_allclose(ssim_map(image, truth).numpy(), full.mean(axis=-1), atol=1e-12)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7), (10, 50), (2, 12)])
def test_ssim_of_images_below_the_window_is_the_mean_of_the_mirrored_map(height, width):
    image, truth = picture_pair(max(height, 2), width)  # the picture maker needs some contrast
    image, truth = image[:height], truth[:height]

    def blur(values):
        return gaussian_filter(values, (1.5, 1.5, 0), mode="reflect", truncate=3.5)

    x, y = image.numpy(), truth.numpy()
    mx, my = blur(x), blur(y)
    variance = blur(x * x) - mx**2 + blur(y * y) - my**2
    expected = (2 * mx * my + 1e-4) * (2 * (blur(x * y) - mx * my) + 9e-4)
    expected = expected / ((mx**2 + my**2 + 1e-4) * (variance + 9e-4))
    assert float(ssim(image, truth)) == pytest.approx(expected.mean(), abs=1e-10)


def test_ssim_agrees_with_a_slow_loop_over_windows():
    image, truth = picture_pair(14, 13)
    offsets = np.arange(-5, 6)
    taps = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(taps, taps) / np.outer(taps, taps).sum()
    values = []
    for v in range(5, 9):
        for u in range(5, 8):
            for channel in range(3):
                x = image[v - 5 : v + 6, u - 5 : u + 6, channel].numpy()
                y = truth[v - 5 : v + 6, u - 5 : u + 6, channel].numpy()
                mx, my = (window * x).sum(), (window * y).sum()
                vx, vy = (window * (x - mx) ** 2).sum(), (window * (y - my) ** 2).sum()
                cov = (window * (x - mx) * (y - my)).sum()
                values.append((2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)))
    assert float(ssim(image, truth)) == pytest.approx(np.mean(values), abs=1e-10)


def test_psnr_closed_forms():
    black = torch.zeros(4, 6, 3)
    assert float(psnr(black + 0.1, black)) == pytest.approx(20.0, abs=1e-4)
    assert float(psnr(black + 1.0, black)) == pytest.approx(0.0, abs=1e-6)
    assert float(psnr(black, black)) == PSNR_CAP_DB


def test_weighted_psnr_agrees_with_a_loop_and_ignores_what_weighs_nothing():
    image, truth = picture_pair(9, 8)
    weight = torch.rand(9, 8, dtype=torch.float64).masked_fill_(torch.rand(9, 8) < 0.3, 0.0)
    total = sum(
        float(weight[v, u]) * float((image[v, u, c] - truth[v, u, c]) ** 2)
        for v in range(9)
        for u in range(8)
        for c in range(3)
    )
    expected = -10 * math.log10(total / (3 * float(weight.sum())))
    assert float(psnr(image, truth, weight)) == pytest.approx(expected, abs=1e-9)
    spoiled = torch.where(weight[..., None] == 0, torch.full_like(image, torch.nan), image)
    assert float(psnr(spoiled, truth, weight)) == pytest.approx(expected, abs=1e-9)
    assert float(psnr_mask(image, truth, torch.ones(9, 8, dtype=torch.bool))) == pytest.approx(
        float(psnr(image, truth)), abs=1e-12
    )
    assert math.isnan(float(psnr_mask(image, truth, torch.zeros(9, 8, dtype=torch.bool))))


def test_ssim_invariances():
    image, truth = picture_pair(20, 33)
    value = float(ssim(image, truth))
    assert float(ssim(truth, image)) == pytest.approx(value, abs=1e-12)
    assert float(ssim(image.flip(1), truth.flip(1))) == pytest.approx(value, abs=1e-12)
    assert float(ssim(image.transpose(0, 1), truth.transpose(0, 1))) == pytest.approx(value, abs=1e-12)
    assert float(ssim(truth, truth)) == pytest.approx(1.0, abs=1e-12)
    everywhere = torch.ones(20, 33, dtype=torch.bool)
    assert float(ssim_mask(image, truth, everywhere)) == pytest.approx(float(ssim_map(image, truth).mean()), abs=1e-12)


@pytest.mark.parametrize("flat", [True, False])
def test_gradients_are_finite_also_for_identical_and_flat_images(flat):
    truth = torch.full((16, 16, 3), 0.5) if flat else picture_pair(16, 16, dtype=torch.float32)[1]
    image = truth.clone().requires_grad_()
    (psnr(image, truth) + ssim(image, truth)).backward()
    assert image.grad is not None
    assert bool(torch.isfinite(image.grad).all())


def test_gradient_of_ssim_agrees_with_finite_differences():
    image, truth = picture_pair(12, 12)
    assert torch.autograd.gradcheck(lambda x: ssim(x, truth), (image.requires_grad_(),), fast_mode=True)


def car_mask(height=24, width=32):
    mask = torch.full((height, width), MaskValue.BACKGROUND, dtype=torch.uint8)
    mask[6:20, 5:26] = MaskValue.CAR
    mask[6:20, 20:26] = MaskValue.UNKNOWN
    return mask


def test_score_image_follows_the_definition_literally():
    image, truth = picture_pair(24, 32, dtype=torch.float32)
    mask = car_mask()
    opacity = torch.rand(24, 32)
    scores = score_image(image, opacity, truth, mask)
    known, car = mask != MaskValue.UNKNOWN, mask == MaskValue.CAR
    on_black = (truth * car[..., None]).double()
    seen = (image * known[..., None]).double()
    errors = ((seen - on_black) ** 2).mean(-1)
    assert scores.psnr == pytest.approx(-10 * math.log10(float(errors[known].mean())), abs=1e-4)
    assert scores.psnr_mask == pytest.approx(-10 * math.log10(float(errors[car].mean())), abs=1e-4)
    full = skimage_ssim(seen, on_black, full=True)[1].mean(-1)
    inside = np.zeros((24, 32), bool)
    inside[5:-5, 5:-5] = True
    assert scores.ssim == pytest.approx(full[inside & known.numpy()].mean(), abs=1e-5)
    assert scores.ssim_mask == pytest.approx(full[car.numpy()].mean(), abs=1e-5)
    rendered_car = (opacity > 0.5) & known
    assert scores.mask_iou == pytest.approx(float((rendered_car & car).sum() / (rendered_car | car).sum()), abs=1e-6)
    assert scores.lpips is None


def test_unknown_pixels_and_the_truths_background_change_no_score():
    image, truth = picture_pair(24, 32, dtype=torch.float32)
    mask, opacity = car_mask(), torch.rand(24, 32)
    before = score_image(image, opacity, truth, mask, lpips=Lpips(lambda a, b: (a - b).abs().mean()))
    unknown, not_car = mask == MaskValue.UNKNOWN, mask != MaskValue.CAR
    other = score_image(
        torch.where(unknown[..., None], 1 - image, image),
        torch.where(unknown, 1 - opacity, opacity),
        torch.where(not_car[..., None], torch.rand_like(truth), truth),
        mask,
        lpips=Lpips(lambda a, b: (a - b).abs().mean()),
    )
    assert other == before


def test_a_perfect_rendering_scores_perfectly():
    _, truth = picture_pair(24, 32, dtype=torch.float32)
    mask = car_mask()
    car = mask == MaskValue.CAR
    scores = score_image(truth * car[..., None], car.float(), truth, mask)
    assert (scores.psnr, scores.psnr_mask, scores.mask_iou) == (PSNR_CAP_DB, PSNR_CAP_DB, 1.0)
    assert scores.ssim == pytest.approx(1.0, abs=1e-6)
    assert scores.ssim_mask == pytest.approx(1.0, abs=1e-6)


def test_where_nothing_can_be_measured_the_score_is_none():
    image, truth = picture_pair(8, 9, dtype=torch.float32)
    unknown = torch.full((8, 9), MaskValue.UNKNOWN, dtype=torch.uint8)
    assert set(vars(score_image(image, torch.ones(8, 9), truth, unknown)).values()) == {None}
    background = torch.zeros_like(unknown)
    scores = score_image(image, torch.ones(8, 9), truth, background)
    assert (scores.psnr_mask, scores.ssim_mask, scores.mask_iou) == (None, None, 0.0)
    assert scores.psnr is not None


def test_a_rendering_with_nan_is_our_bug():
    image, truth = picture_pair(12, 12, dtype=torch.float32)
    image[3, 3, 0] = torch.nan
    with pytest.raises(AssertionError, match="NaN"):
        score_image(image, torch.ones(12, 12), truth, torch.zeros(12, 12, dtype=torch.uint8))


def test_lpips_is_a_value_or_a_reason():
    lpips, reason = load_lpips()
    assert (lpips is None) == bool(reason)
    if lpips is None:
        assert reason is not None
        assert "torchmetrics" in reason or "weights" in reason
    small = Lpips(lambda a, b: (a - b).mean())
    assert small(torch.rand(31, 64, 3), torch.rand(31, 64, 3)) is None


@pytest.mark.slow
def test_lpips_of_equal_images_is_zero_and_grows_with_noise():
    lpips, reason = load_lpips()
    if lpips is None:
        pytest.skip(f"LPIPS: {reason}")
    image, truth = picture_pair(64, 64, dtype=torch.float32)
    assert lpips(truth, truth) == pytest.approx(0.0, abs=1e-6)
    assert lpips(image, truth) > 0.01
