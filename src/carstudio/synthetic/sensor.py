"""From radiance to a photo: blur, exposure, white balance, noise, tone curve, JPEG."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from carstudio.images import decode_image, encode_jpeg
from carstudio.synthetic.materials import srgb_from_linear


@dataclass(frozen=True)
class Sensor:
    """One photo's camera electronics."""

    brightness: float
    """Mean linear value that the exposure aims at; 0.18 is a photographer's grey card."""
    gains: Float[np.ndarray, "3"]
    """White balance."""
    blur_px: float
    shot_noise: float
    """Standard deviation of the noise at white, linear, growing with the root of the signal."""
    read_noise: float
    """Standard deviation of the noise at black, linear."""
    contrast: float
    """0: plain sRGB; 1: a strong S-curve."""
    jpeg_quality: int


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """A plausible camera: KITTI's is dark, noisy and hard in contrast, a phone's bright and clean."""
    return Sensor(
        brightness=float(np.exp(rng.uniform(np.log(0.08), np.log(0.25)))),
        gains=1 + rng.normal(0, 0.03, 3),
        blur_px=float(rng.uniform(0.0, 0.6)),
        shot_noise=float(rng.uniform(0.004, 0.02)),
        read_noise=float(rng.uniform(0.0005, 0.003)),
        contrast=float(rng.uniform(0.1, 0.6)),
        jpeg_quality=int(rng.integers(75, 96)),
    )


def develop(
    radiance: Float[np.ndarray, "height width 3"], sensor: Sensor, rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """The photo of a picture in linear radiance. Very bright spots are cut at four times white before the blur."""
    exposure = sensor.brightness / max(float(np.minimum(radiance, 2.0).mean()), 1e-6)
    linear = np.minimum(radiance * exposure * sensor.gains, 4.0)
    if sensor.blur_px > 0.15:
        linear = cv2.GaussianBlur(linear, (0, 0), sensor.blur_px)
    deviation = np.sqrt(sensor.shot_noise**2 * np.maximum(linear, 0) + sensor.read_noise**2)
    linear = np.clip(linear + deviation * rng.standard_normal(linear.shape), 0, None)
    linear = np.where(linear < 0.7, linear, 0.7 + 0.3 * (1 - np.exp(-(linear - 0.7) / 0.3)))  # highlights roll off
    display = srgb_from_linear(linear)
    curve = display * display * (3 - 2 * display)
    display = display + sensor.contrast * (curve - display)
    pixels = np.clip(np.round(display * 255), 0, 255).astype(np.uint8)
    return decode_image(encode_jpeg(pixels, quality=sensor.jpeg_quality), name="photo")
