"""How close a rendering comes to its photograph: PSNR, SSIM, LPIPS and mask IoU, per image.

Images are (height, width, channels) in [0, 1], data range 1; masks hold the values of `MaskValue`. All metrics are of
ONE image; a table's figure is the mean over images. Metrics are differentiable in their first argument.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import conv2d

from carstudio.dataset.patch import MaskValue
from carstudio.evaluation.perceptual import Lpips
from carstudio.geometry import overlap

PSNR_CAP_DB = 100.0  # of (nearly) identical images: JSON has no infinity; 8-bit rounding alone gives 59 dB
SSIM_SIGMA_PX = 1.5  # Wang et al. 2004
SSIM_RADIUS_PX = 5  # an 11 x 11 window
SSIM_K1, SSIM_K2 = 0.01, 0.03  # Wang et al. 2004, data range 1
OPACITY_THRESHOLD = 0.5  # above it a rendered pixel counts as car


@dataclass(frozen=True, kw_only=True)
class ImageScores:
    """Scores of one image against its truth; None where there is nothing to measure (no known, or no car pixel)."""

    psnr: float | None  # dB, over the known pixels of the crop, truth on black
    psnr_mask: float | None  # dB, over car pixels only
    ssim: float | None  # over the known pixels of the crop, truth on black
    ssim_mask: float | None  # the same map averaged over car pixels only
    lpips: float | None  # AlexNet; smaller is better
    mask_iou: float | None  # opacity > 0.5 against the car mask, over known pixels


def psnr(
    image: Float[Tensor, "height width channel"],
    truth: Float[Tensor, "height width channel"],
    weight: Float[Tensor, "height width"] | Bool[Tensor, "height width"] | None = None,
) -> Float[Tensor, ""]:
    """-10 log10 of the (weighted) mean squared error, dB; at most `PSNR_CAP_DB`, NaN where all weights are zero."""
    error = (image - truth).square().mean(dim=-1)
    if weight is None:
        mean = error.mean()
    else:
        weight = weight.to(error.dtype)
        mean = (torch.where(weight > 0, error, torch.zeros_like(error)) * weight).sum() / weight.sum()
    return -10.0 * torch.log10(mean.clamp(min=10 ** (-PSNR_CAP_DB / 10)))


def gaussian_window(radius_px: int, sigma_px: float, like: Tensor) -> Float[Tensor, " tap"]:
    """Samples of a Gaussian at -radius .. radius that sum to one."""
    offsets = torch.arange(-radius_px, radius_px + 1, dtype=like.dtype, device=like.device)
    window = torch.exp(-0.5 * (offsets / sigma_px).square())
    return window / window.sum()


def _mirror_indices(length: int, radius: int, device: torch.device) -> Tensor:
    """Indices -radius .. length + radius - 1 folded back at the outer edges of the first and last pixel."""
    folded = torch.arange(-radius, length + radius, device=device) % (2 * length)
    return torch.where(folded < length, folded, 2 * length - 1 - folded)


def _blur(planes: Float[Tensor, "plane 1 height width"]) -> Float[Tensor, "plane 1 height width"]:
    """Gaussian mean around every pixel, the image mirrored at its edges (scipy's "reflect")."""
    window = gaussian_window(SSIM_RADIUS_PX, SSIM_SIGMA_PX, planes)
    rows = _mirror_indices(planes.shape[-2], SSIM_RADIUS_PX, planes.device)
    columns = _mirror_indices(planes.shape[-1], SSIM_RADIUS_PX, planes.device)
    padded = planes[..., rows, :][..., columns]
    return conv2d(conv2d(padded, window[None, None, :, None]), window[None, None, None, :])


def ssim_map(
    image: Float[Tensor, "height width channel"], truth: Float[Tensor, "height width channel"]
) -> Float[Tensor, "height width"]:
    """Structural similarity around every pixel, mean over channels (Wang et al. 2004, Eq. 13).

    Gaussian window 11 x 11, sigma 1.5 px, population covariance, the image mirrored at its edges: the map of skimage's
    `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True)`.
    """
    x, y = image.permute(2, 0, 1)[:, None], truth.permute(2, 0, 1)[:, None]
    mean_x, mean_y, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    variance = (xx - mean_x * mean_x) + (yy - mean_y * mean_y)
    covariance = xy - mean_x * mean_y
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity = similarity / ((mean_x * mean_x + mean_y * mean_y + c1) * (variance + c2))
    return similarity.mean(dim=0)[0]


def interior(height: int, width: int, device: torch.device | str = "cpu") -> Bool[Tensor, "height width"]:
    """Pixels whose whole SSIM window lies in the image; every pixel when a side is below 11 px and none has that."""
    inside = torch.zeros(height, width, dtype=torch.bool, device=device)
    inside[SSIM_RADIUS_PX : height - SSIM_RADIUS_PX, SSIM_RADIUS_PX : width - SSIM_RADIUS_PX] = True
    return inside if bool(inside.any()) else torch.ones_like(inside)


def ssim(
    image: Float[Tensor, "height width channel"], truth: Float[Tensor, "height width channel"]
) -> Float[Tensor, ""]:
    """Mean of `ssim_map` over the pixels whose 11 x 11 window lies in the image, as skimage and most papers do.

    An image with a side below 11 px has no such pixel (skimage refuses it): then the mean is over all its pixels, with
    the image mirrored at its edges.
    """
    return ssim_map(image, truth)[interior(image.shape[0], image.shape[1], image.device)].mean()


def masked_mean(values: Float[Tensor, "height width"], mask: Bool[Tensor, "height width"]) -> Float[Tensor, ""]:
    """Mean over the pixels of `mask`, NaN when there is none."""
    return values[mask].mean()


def psnr_mask(
    image: Float[Tensor, "height width channel"],
    truth: Float[Tensor, "height width channel"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """PSNR over the pixels of `mask` only, NaN when there is none."""
    return psnr(image, truth, mask)


def ssim_mask(
    image: Float[Tensor, "height width channel"],
    truth: Float[Tensor, "height width channel"],
    mask: Bool[Tensor, "height width"],
) -> Float[Tensor, ""]:
    """Mean of `ssim_map` over the pixels of `mask`, also those near the image's edge (a tight crop's car is there)."""
    return masked_mean(ssim_map(image, truth), mask)


def _number(value: Tensor) -> float | None:
    number = float(value)
    return None if math.isnan(number) else number


def score_image(
    rendered_rgb: Float[Tensor, "height width 3"],
    opacity: Float[Tensor, "height width"],
    truth_rgb: Float[Tensor, "height width 3"],
    mask: UInt8[Tensor, "height width"],
    *,
    lpips: Lpips | None = None,
) -> ImageScores:
    """All metrics of one box crop, truth on black.

    `rendered_rgb` is composited on black and is clamped to [0, 1]; the truth is black wherever the mask is not car.
    Unknown pixels take part in no metric: PSNR and IoU leave them out; for SSIM and LPIPS both images are black there
    before filtering, and the SSIM map is averaged over known pixels only. Scored without gradients.
    """
    with torch.no_grad():
        known, car = mask != MaskValue.UNKNOWN, mask == MaskValue.CAR
        _refuse_non_finite(rendered_rgb, opacity)
        image = torch.where(known[..., None], rendered_rgb.clamp(0.0, 1.0), torch.zeros_like(rendered_rgb))
        truth = torch.where(car[..., None], truth_rgb, torch.zeros_like(truth_rgb))
        similarity = ssim_map(image, truth)
        inside = interior(mask.shape[0], mask.shape[1], mask.device) & known
        iou = overlap.mask_iou((opacity > OPACITY_THRESHOLD) & known, car)
        return ImageScores(
            psnr=_number(psnr(image, truth, known)),
            psnr_mask=_number(psnr_mask(image, truth, car)),
            ssim=_number(masked_mean(similarity, inside if bool(inside.any()) else known)),
            ssim_mask=_number(masked_mean(similarity, car)),
            lpips=lpips(image, truth) if lpips is not None and bool(known.any()) else None,
            mask_iou=_number(iou) if bool(known.any()) else None,
        )


def _refuse_non_finite(rendered_rgb: Tensor, opacity: Tensor) -> None:
    assert bool(torch.isfinite(rendered_rgb).all()), "the rendering holds NaN or infinity; a model must not return that"
    assert bool(torch.isfinite(opacity).all()), "the rendered opacity holds NaN or infinity"
