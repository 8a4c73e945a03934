"""Figures of the paper's Tables II and III, to stand beside ours; its data, and its budget, were others."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperFigures:
    """PSNR (dB), SSIM and LPIPS of one row."""

    psnr: float
    ssim: float
    lpips: float


# Table II: KITTI-DET, 9 : 1 by patch, every instance unseen; 500,000 steps x 3,072 rays.
ZERO_SHOT = {
    "pixelnerf-resnet": PaperFigures(11.61, 0.1948, 0.7375),
    "pixelnerf-mlp": PaperFigures(17.87, 0.5103, 0.4014),
    "autorf": PaperFigures(20.75, 0.5903, 0.3466),
    "car-nerf-no-mask": PaperFigures(20.93, 0.6020, 0.3396),
    "car-nerf": PaperFigures(20.23, 0.6209, 0.3284),
}
# Table III: KITTI-MOT, cars with several photos.
MULTI_VIEW = {
    "pixelnerf-mlp": PaperFigures(17.16, 0.4715, 0.4343),
    "autorf": PaperFigures(17.84, 0.5212, 0.3852),
    "code-nerf": PaperFigures(19.01, 0.5737, 0.3299),
    "car-nerf-multi-view": PaperFigures(17.40, 0.4965, 0.4075),
    "car-nerf-single-view": PaperFigures(20.12, 0.6251, 0.2825),
}
