"""The cars of a log's tracks: latents encoded from each one's best photographs and fitted over all of them.

One CAR per track, so that a car keeps its look wherever it is put. A finished car is kept when the run is repeated with
the same settings; a track that cannot be lifted stays without a car and its reason is told.
"""

import copy
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.pixels import PreparedPatch, mirror_patch, prepare_patch
from carstudio.errors import InputError
from carstudio.files import read_json, write_bytes, write_json
from carstudio.fitting.car_file import DESCRIPTION, Car, load_car, put_weights, save_car
from carstudio.fitting.optimise import FitConfig
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import viewing_angles
from carstudio.images import to_uint8, write_png
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.perception.results import PhotoSegmenter, Segmenter
from carstudio.progress import Report, silent
from carstudio.scene.graph import Scene, Track
from carstudio.scene.kitti import Log
from carstudio.scene.own_pictures import own_picture
from carstudio.scene.shelf import PATCH, PATCH_DESCRIPTION, PATCH_MASK, CarShelf
from carstudio.scene.views import ViewConfig, patches_of_track, psnr_on_car
from carstudio.training.batches import stack_boxes
from carstudio.training.checkpoint import describe_model, load_model
from carstudio.training.patch_fitting import fit_patches

FIT_PICTURE = "fit.png"
# A car is fitted to many photographs here, so its own copy of the field may follow them (Car-Studio section IV-C): on
# KITTI's track 0001/4 this gave 16.6 dB, the codes alone 12.8.
SCENE_FIT = FitConfig(latent_rate=2e-2, field_rate=1e-2)
_OTHER_SIDE_RAD, _UNSEEN_RAD = math.radians(30), math.radians(50)
_KEY = "scene_key"  # of a car's provenance: the settings and photographs it was made from


@dataclass(frozen=True)
class LiftConfig:
    """How tracks become cars."""

    model: str = "car-gaussians"
    """Folder of a run, or a bundled model's name."""
    types: tuple[str, ...] = ("Car", "Van")
    """Label types that are lifted; others stay as the photographs show them."""
    views: ViewConfig = field(default_factory=ViewConfig)
    """Which photographs."""
    fit: FitConfig = SCENE_FIT
    """How the latents are fitted."""
    mirrors: bool = True
    """Also show the photographs flipped left to right where they show a side that none shows: cars are symmetric."""
    rays: int = 256
    """Pixels per photograph and step."""
    seed: int = 0
    """Which pixels."""


@dataclass(frozen=True)
class Lifted:
    """A scene whose tracks have cars; per lifted track its PSNR (dB, car pixels of its views); why others have none."""

    scene: Scene
    psnr: dict[str, float | None]
    problems: tuple[str, ...]


def lift_tracks(
    log: Log,
    folder: Path,
    segmenter: Segmenter | PhotoSegmenter,
    config: LiftConfig,
    *,
    segmenter_name: str,
    device: torch.device | str = "cpu",
    provenance: dict[str, Any] | None = None,
    report: Report = silent,
) -> Lifted:
    """Make (or keep) the car of every track of `config.types`; cars lie below `folder/cars`."""
    shelf = CarShelf(folder)
    described = describe_model(config.model)
    model = load_model(config.model, device=device)
    wanted = [track for track in log.scene.tracks.values() if track.type in config.types]
    scene, problems, psnr = log.scene, list[str](), dict[str, float | None]()
    for done, track in enumerate(wanted):
        report("lifting cars", done, len(wanted), f"track {track.track_id}")
        name = f"track-{track.track_id}"
        key = _key(log, track, config, described.sha256, segmenter_name)
        made = _finished(shelf.folder(name), key)
        try:
            if made is None:
                records, rejected = patches_of_track(log, track, segmenter, config.views)
                if not records:
                    raise InputError("; ".join(rejected[:3]) or "no photograph shows it")
                made = fit_track(model, track, records, config)
                about = {**(provenance or {}), **made.provenance, _KEY: key}
                made = replace(made, model_sha256=described.sha256, provenance=about)
                _save(shelf.folder(name), made, records[0], model)
        except InputError as error:
            problems.append(f"track {track.track_id} has no car: {error}")
            continue
        except (ValueError, RuntimeError, ArithmeticError) as error:  # one bad track must not cost the others
            problems.append(f"track {track.track_id} has no car: {type(error).__name__}: {str(error)[:200]}")
            continue
        scene = scene.with_track(replace(scene.tracks[track.track_id], car=shelf.ref(name)))
        psnr[track.track_id] = made.provenance.get("psnr_mask")
    report("lifting cars", len(wanted), max(len(wanted), 1), "")
    return Lifted(scene, psnr, tuple(problems))


def fit_track(model: CategoryModel, track: Track, records: Sequence[PatchRecord], config: LiftConfig) -> Car:
    """The car that explains all patches of a track best; its provenance says from which and how well."""
    patches = [prepare_patch(record.decode(), model.encoder_side_px) for record in records]
    shown = patches + (mirrored_views(patches) if config.mirrors else [])
    codes_only = replace(config.fit, field_rate=0.0)
    fitted = fit_patches(model, shown, codes_only, rays=config.rays, seed=config.seed)
    car = Car(
        latents=Latents(fitted.latents.shape.cpu(), fitted.latents.texture.cpu()),
        size=median_size(track),
        model_name=Path(config.model).name,
        model_sha256="",
        instance_id=records[0].instance_id,
        licence=records[0].licence,
    )
    if config.fit.field_rate:
        shown = shown + unseen_sides(model, car, shown)
        fitted = fit_patches(model, shown, config.fit, rays=config.rays, seed=config.seed)
        car = replace(
            car,
            latents=Latents(fitted.latents.shape.cpu(), fitted.latents.texture.cpu()),
            weights={name: weight.cpu() for name, weight in fitted.weights.items()},
        )
    values = [value for value in (_psnr(model, car, patch) for patch in patches) if value is not None]
    provenance = {
        "patches": [record.patch_id for record in records],
        "steps": fitted.steps,
        "held_out_loss": [list(point) for point in fitted.curve],
        "psnr_mask": round(sum(values) / len(values), 3) if values else None,
        "settings": json.loads(json.dumps(asdict(config))),
    }
    return replace(car, provenance=provenance)


def mirrored_views(patches: Sequence[PreparedPatch]) -> list[PreparedPatch]:
    """The photographs flipped left to right that show a symmetric car from where no photograph does.

    A log often passes a car on one side only; without them its other side is whatever the model makes of it.
    """
    sides = [float(viewing_angles(patch.box)[0]) for patch in patches]

    def is_new(side: float) -> bool:
        return min(abs(math.remainder(side - other, 2 * math.pi)) for other in sides) > _OTHER_SIDE_RAD

    return [mirror_patch(patch) for patch, side in zip(patches, sides, strict=True) if is_new(-side)]


def unseen_sides(model: CategoryModel, car: Car, patches: Sequence[PreparedPatch]) -> list[PreparedPatch]:
    """The car's own pictures from sides that no patch shows, so that a field fitted to the others forgets none.

    `car` is one whose codes alone were fitted: from there it looks as the model believes that such a car does.
    """
    sides = [float(viewing_angles(patch.box)[0]) for patch in patches]

    def is_unseen(side: float) -> bool:
        return min(abs(math.remainder(side - other, 2 * math.pi)) for other in sides) > _UNSEEN_RAD

    angles = [angle for angle in range(0, 360, 45) if is_unseen(math.radians(angle))]
    pictures = [own_picture(model, car, azimuth_deg=float(angle)) for angle in angles]
    return [prepare_patch(picture, model.encoder_side_px) for picture in pictures]


def median_size(track: Track) -> tuple[float, float, float]:
    """The middle of a track's box sizes (length, height, width), m."""
    length, height, width = (median(box.size[axis] for box in track.boxes.values()) for axis in range(3))
    return length, height, width


def render_patch(model: CategoryModel, car: Car, patch: PreparedPatch) -> dict[str, torch.Tensor]:
    """rgb, opacity and depth of a car where a patch shows it, on the CPU."""
    device = next(model.parameters()).device
    latents = Latents(car.latents.shape.to(device), car.latents.texture.to(device))
    box = stack_boxes([patch.box])
    height, width = patch.mask.shape
    camera = replace(patch.camera, width=width, height=height)
    found = render_image(_with_weights(model, car), camera.to(device), latents, box.to(device))
    return {name: value.cpu() for name, value in found.items()}


def _with_weights(model: CategoryModel, car: Car) -> CategoryModel:
    if not car.weights:
        return model
    own = copy.deepcopy(model)
    put_weights(own, car, name=car.instance_id)
    return own


def _psnr(model: CategoryModel, car: Car, patch: PreparedPatch) -> float | None:
    found = render_patch(model, car, patch)
    truth = patch.rgb.float() / 255
    return psnr_on_car(found["rgb"], truth, patch.mask == MaskValue.CAR)


def _save(folder: Path, car: Car, best: PatchRecord, model: CategoryModel) -> None:
    """The car, and beside it the photograph it is best seen in (for recolouring by photograph) and how it is met."""
    assert best.mask is not None
    assert best.box is not None
    patch = prepare_patch(best.decode(), model.encoder_side_px)
    write_bytes(folder / PATCH, best.image)
    write_bytes(folder / PATCH_MASK, best.mask)
    write_json(folder / PATCH_DESCRIPTION, patch_description(patch.camera.intrinsics, patch.box))
    found = render_patch(model, car, patch)
    on_white = found["rgb"] + (1 - found["opacity"][..., None])
    write_png(folder / FIT_PICTURE, np.concatenate([patch.rgb.numpy(), to_uint8(on_white.numpy())], axis=1))
    save_car(folder, car)


def patch_description(intrinsics: torch.Tensor, box: Box3D) -> dict[str, Any]:
    """`patch.json`: intrinsics of the crop (px) and the box in its camera."""
    return {
        "intrinsics": intrinsics.tolist(),
        "box_center": box.center.tolist(),
        "box_size": box.size.tolist(),
        "box_rotation": box.rotation.tolist(),
    }


def _key(log: Log, track: Track, config: LiftConfig, model_sha256: str, segmenter: str) -> str:
    """What a car depends on, as one checksum."""
    images = {frame.index: frame.image.sha256 for frame in log.scene.frames}
    used = {
        "config": asdict(replace(config, model="")),
        "model": model_sha256,
        "segmenter": segmenter,
        "boxes": {index: [images[index], asdict(box)] for index, box in track.boxes.items()},
        "neighbours": {  # nearer objects shape the masks
            name: {index: asdict(box) for index, box in other.boxes.items() if index in track.boxes}
            for name, other in log.scene.tracks.items()
        },
    }
    return hashlib.sha256(json.dumps(used, sort_keys=True).encode()).hexdigest()


def _finished(folder: Path, key: str) -> Car | None:
    """The car of an earlier run with the same settings and photographs; a damaged one is made anew."""
    try:
        if (folder / DESCRIPTION).is_file() and read_json(folder / DESCRIPTION)["provenance"].get(_KEY) == key:
            return load_car(folder)
    except (InputError, KeyError, TypeError, AttributeError):
        pass
    return None
