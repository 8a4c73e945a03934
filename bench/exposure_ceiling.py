"""How well any model can do on the frozen set's novel views, since a photo's exposure is its own.

Usage: python -m bench.exposure_ceiling [--sensors 64] [--lights 0]

Each photo has a sensor drawn for it alone (exposure, white balance, contrast, blur, noise), which no other photo of the
car tells. Even who knows the car, its street and its light exactly can at best show the mean of the pictures that all
sensors would make. That mean is scored here as a model's picture would be, beside the best gain per photo. With lights,
the light is unknown too and the mean is over lights as well: what is left to who knows shape and paint alone.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Float
from rich.progress import track

from carstudio.dataset.outlines import crop_window
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.sources.synthetic import frozen_benchmark, make_car
from carstudio.evaluation.metrics import ImageScores, score_image
from carstudio.evaluation.summary import estimate
from carstudio.synthetic.light import draw_light
from carstudio.synthetic.photographs import RayCaster, Shot, draw_scene, draw_shots, take_photograph
from carstudio.synthetic.sensor import develop, draw_sensor
from carstudio.synthetic.shading import Scene, prepare_scene

EVERY = 4  # `carstudio evaluate --limit 128` scores each fourth of the 512 photos


@dataclass(frozen=True)
class Asked:
    """How it is measured."""

    sensors: int = 64
    """Sensors drawn per photo (and light)."""
    lights: int = 0
    """Lights drawn per car; 0: its own is known."""
    cars: int = 64
    """So many cars of the set."""


def ceilings(asked: Asked) -> dict[str, list[tuple[float, str]]]:
    """PSNR, SSIM and their like of the best guess, one per scored photo, with the car's name."""
    config = frozen_benchmark(Path("unused"))
    found: dict[str, list[tuple[float, str]]] = {}
    for index in track(range(asked.cars), description="cars"):
        seed, car = (config.seed, index), make_car(config, [], index)
        scene = draw_scene(car, np.random.default_rng([*seed, 1]))
        draws = np.random.default_rng([*seed, 99])
        lights = [prepare_scene(scene.tracer, scene.street, draw_light(draws)) for _ in range(asked.lights)]
        shots = draw_shots(car, scene, seed=seed, num_views=config.views, size_px=config.size, cameras=config.cameras)
        for view, shot in enumerate(shots):
            if view % EVERY == 0:
                for name, value in scores_of(scene, shot, best_guess(shot, lights, asked.sensors, draws)).items():
                    found.setdefault(name, []).append((value, str(index)))
    return found


def best_guess(
    shot: Shot, lights: list[Scene], sensors: int, draws: np.random.Generator
) -> Float[np.ndarray, "height width 3"]:
    """The mean of all pictures that the view might have given, in [0, 1]: what has the least squared error."""
    radiances = [RayCaster().prepare(scene)(shot.viewpoint, 0) for scene in lights] or [shot.radiance]
    pictures = [develop(radiance, draw_sensor(draws), draws) for radiance in radiances for _ in range(sensors)]
    return np.asarray(np.mean(pictures, axis=0, dtype=np.float64)) / 255


def scores_of(scene: Scene, shot: Shot, guess: Float[np.ndarray, "height width 3"]) -> dict[str, float]:
    """Scores of a guess on the photo's crop, with the true mask, as it is and after the gain that suits it best."""
    photo = take_photograph(scene, shot.viewpoint, shot.sensor, shot.rng, shot.radiance)
    rows, columns = np.nonzero(photo.mask)
    size = photo.mask.shape[0]
    window = crop_window(
        (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)), size, size
    )
    alpha = photo.mask[window.slices]
    shown = guess[window.slices] * alpha[..., None]
    truth = photo.image[window.slices] / 255
    gain = (shown * truth).sum() / (shown * shown).sum()
    plain, exposed = (_score(picture, truth, alpha) for picture in (shown, np.clip(shown * gain, 0, 1)))
    named = {name: value for name, value in asdict(plain).items() if value is not None}
    return named | {"psnr_exposed": exposed.psnr or float("nan")}


def _score(
    shown: Float[np.ndarray, "height width 3"], truth: Float[np.ndarray, "height width 3"], alpha: np.ndarray
) -> ImageScores:
    mask = np.where(alpha, MaskValue.CAR, MaskValue.BACKGROUND).astype(np.uint8)
    opacity = torch.from_numpy(alpha.astype(np.float32))
    rgb, real = (torch.from_numpy(np.ascontiguousarray(part)).float() for part in (shown, truth))
    return score_image(rgb, opacity, real, torch.from_numpy(np.ascontiguousarray(mask)))


if __name__ == "__main__":
    asked = tyro.cli(Asked, description=__doc__)
    rows = ceilings(asked)
    figures = {name: estimate([v for v, _ in found], [car for _, car in found]) for name, found in rows.items()}
    print(json.dumps({name: [round(e.mean, 4), e.low, e.high] for name, e in figures.items()}, indent=1))
