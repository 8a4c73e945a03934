"""The training loss (Car-Studio Eq. 6-8): masked colour and opacity against the mask, coarse and fine.

Means run over channels and over the rays that hit the box and whose pixel is known.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from carstudio.models.interface import Latents
from carstudio.rendering.volume import Rendering

USUAL_ERROR, LEAST_ERROR = 0.01, 0.002  # squared colour errors of photos: 20 dB and 27 dB


@dataclass(frozen=True)
class LossConfig:
    """Which terms there are; the defaults are the paper's."""

    colour: Literal["masked", "whole-crop"] = "masked"
    """"masked": only car pixels (Eq. 6); "whole-crop": all pixels, the background against black."""
    mask_weight: float = 1.0
    """lambda_s of Eq. 8 (released: 1); 0 goes with "whole-crop", or nothing would form a silhouette."""
    mask_error: Literal["squared", "log"] = "squared"
    """"squared": Eq. 7; "log": AutoRF's occupancy loss, the logarithm of how likely the opacity makes the mask."""
    code_weight: float = 0.0
    """Weight of the codes' lengths (CodeNeRF: 1e-4); 0: codes are free."""
    exposed_share: float = 0.0
    """Share of the colour term that is taken after the gain that suits each photo best (not in the paper): exposure is
    a camera's whim, and a model that follows it learns details later."""
    photo_error: Literal["mean", "log"] = "mean"
    """How a photo's mean squared colour error counts: "mean": as it is (Eq. 6); "log": its logarithm, as in PSNR, so
    that dark cars, whose errors are small, are learned as well as bright ones (not in the paper)."""
    coarse_weight: float = 0.1
    """lambda_c of Eq. 6-7 (released: 0.1)."""

    def __post_init__(self) -> None:
        assert self.mask_weight > 0 or self.colour == "whole-crop", "without mask loss colour must cover the whole crop"


def training_loss(
    levels: tuple[Rendering, ...],
    rgb: Float[Tensor, "batch ray 3"],
    alpha: Float[Tensor, "batch ray"],
    counts: Bool[Tensor, "batch ray"],
    config: LossConfig,
) -> dict[str, Float[Tensor, ""]]:
    """Named, weighted terms whose sum is Eq. 8; `counts` marks the rays that hit the box and are known."""
    share = counts.float() / counts.sum().clamp(min=1)
    terms = {}
    for level, rendering in enumerate(levels):
        is_last = level == len(levels) - 1
        name, weight = ("fine", 1.0) if is_last else ("coarse", config.coarse_weight)
        plain = over_photos(colour_error(rendering.rgb, rgb, alpha, config.colour), share, config.photo_error)
        if config.exposed_share:
            gain = best_gain(rendering.rgb, rgb, alpha * counts)
            error = colour_error(rendering.rgb * gain, rgb, alpha, config.colour)
            plain = plain + config.exposed_share * (over_photos(error, share, config.photo_error) - plain)
        terms[f"colour_{name}"] = weight * plain
        if config.mask_weight:
            error = mask_error(rendering.opacity, alpha, config.mask_error)
            terms[f"mask_{name}"] = weight * config.mask_weight * (share * error).sum()
    return terms


def over_photos(
    error: Float[Tensor, "batch ray"], share: Float[Tensor, "batch ray"], kind: Literal["mean", "log"]
) -> Float[Tensor, ""]:
    """One number of the errors of rays whose shares sum to 1 (or are all 0): their mean, or a mean of logarithms.

    A photo with mean error e counts with USUAL_ERROR log(1 + e / LEAST_ERROR): its slope is near 1 where e is usual and
    falls as 1 / e above, so that a decibel of one photo is worth as much as that of another.
    """
    if kind == "mean":
        return (share * error).sum()
    of_photo = share.sum(dim=-1)
    mean = (share * error).sum(dim=-1) / of_photo.clamp(min=1e-12)
    return (of_photo * USUAL_ERROR * torch.log1p(mean / LEAST_ERROR)).sum()


def best_gain(
    rendered: Float[Tensor, "batch ray 3"], rgb: Float[Tensor, "batch ray 3"], weight: Float[Tensor, "batch ray"]
) -> Float[Tensor, "batch 1 1"]:
    """The factor (0.5 to 2) that brings each photo's rendered colours nearest to the truth, without gradient."""
    seen = rendered.detach() * weight[..., None]
    return ((seen * rgb).sum(dim=(1, 2)) / (seen * rendered.detach()).sum(dim=(1, 2)).clamp(min=1e-6)).clamp(0.5, 2)[
        :, None, None
    ]


def colour_error(
    rendered: Float[Tensor, "batch ray 3"],
    rgb: Float[Tensor, "batch ray 3"],
    alpha: Float[Tensor, "batch ray"],
    kind: Literal["masked", "whole-crop"],
) -> Float[Tensor, "batch ray"]:
    """Squared colour error per ray, mean over channels: alpha-masked (Eq. 6), or against the car on black."""
    if kind == "masked":
        return alpha * ((rendered - rgb) ** 2).mean(dim=-1)
    return ((rendered - alpha[..., None] * rgb) ** 2).mean(dim=-1)


def mask_error(
    opacity: Float[Tensor, "batch ray"], alpha: Float[Tensor, "batch ray"], kind: Literal["squared", "log"]
) -> Float[Tensor, "batch ray"]:
    """Opacity against the mask per ray: squared (Eq. 7), or -log of the mask's likelihood (AutoRF Eq. 7).

    AutoRF writes -log(y (1/2 - t) + 1/2) with y = 1 on the car, -1 beside it and t the light that gets through; that
    is the binary cross-entropy of 1 - t. The probability is kept 1e-4 away from 0, so that gradients stay finite.
    """
    if kind == "squared":
        return (opacity - alpha) ** 2
    likelihood = (2 * alpha - 1) * (opacity - 0.5) + 0.5
    return -torch.log(likelihood.clamp(min=1e-4))


def code_length(latents: Latents) -> Float[Tensor, ""]:
    """||z_shape|| + ||z_texture||, mean over the cars of a batch: CodeNeRF's regulariser (its Eq. 3)."""
    return (latents.shape.norm(dim=-1) + latents.texture.norm(dim=-1)).mean()


def masked_psnr(rendering: Rendering, rgb: Float[Tensor, "batch ray 3"], alpha: Float[Tensor, "batch ray"]) -> float:
    """PSNR in dB over the car's pixels of a batch, for progress bars."""
    error = (alpha * ((rendering.rgb.detach() - rgb) ** 2).mean(dim=-1)).sum() / alpha.sum().clamp(min=1)
    return float(-10 * torch.log10(error.clamp(min=1e-10)))
