"""`carstudio synth`: photographs of synthetic cars (or of GLB meshes) as a CarPatch3D store with exact truth.

Each car is worked on by itself, from (seed, index of the car) alone, so the number of processes changes nothing, and a
run that was cut off goes on after its whole shards.
"""

import hashlib
import json
import os
import time
from collections.abc import Iterable
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from carstudio.dataset.build import judge_and_split, summarize
from carstudio.dataset.filters import FilterRecipe
from carstudio.dataset.measured import azimuths_deg, measure
from carstudio.dataset.outlines import crop_window
from carstudio.dataset.patch import MaskValue, PatchRecord
from carstudio.dataset.runs import is_made_already, write_run
from carstudio.dataset.splits import kept_views, seen_from, split_by_drive
from carstudio.dataset.store import StoreWriter, open_store
from carstudio.dataset.summary import BuildSummary
from carstudio.dataset.workers import ordered_map
from carstudio.errors import InputError
from carstudio.geometry.box3d import envelope
from carstudio.geometry.orbit import NUM_TURNS
from carstudio.geometry.overlap import box2d_iou
from carstudio.geometry.transforms import quaternion_from_rotation
from carstudio.images import encode_depth, encode_png
from carstudio.locks import clear_leftovers
from carstudio.progress import Report, silent
from carstudio.synthetic.benchmark import BENCHMARK_CARS, BENCHMARK_SEED, BENCHMARK_SIZE_PX, BENCHMARK_VIEWS
from carstudio.synthetic.cameras import CameraKind
from carstudio.synthetic.cars import Car, draw_car
from carstudio.synthetic.glb import load_glb
from carstudio.synthetic.materials import Paint
from carstudio.synthetic.photographs import Photograph, RayCaster, Renderer, draw_photographs, photograph_drive

__all__ = ["BuildSummary", "SynthConfig", "frozen_benchmark", "synthesize"]

SOURCE = "synthetic"
MIN_SIZE_PX, MAX_SIZE_PX = 16, 4096
# Truth is exact, so nothing is rejected; the filters still write down what they measure.
KEEP_ALL = FilterRecipe(height_px=0.0, width_px=0.0, depth_m=1000.0, score_mask=0.0, mask_ratio=0.0, box_iou=0.0)


@dataclass(frozen=True, kw_only=True)
class SynthConfig:
    """What to photograph and how."""

    out: Path
    """Folder of the store; must be new, empty or an unfinished store."""
    cars: int = 200
    """Number of cars; with --meshes the files are taken in turn, each time in another street and light."""
    views: int = 12
    """Photos of each car, from all around it."""
    size: int = 128
    """Width and height of a photo, px; the car fills 70 to 95 % of it."""
    meshes: Path | None = None
    """A GLB file or a folder of them (glTF axes: +Y up, +Z front; metres) instead of generated cars."""
    cameras: CameraKind = "mixed"
    """kitti: level, 1.65 m high, 6 to 22 m away; phone: pitched down by 5 to 15 degrees, nearer; mixed: both."""
    tracks: bool = False
    """Each car is a track: --views frames of one drive past it (KITTI's camera), and 18 true views of it turned where
    it stands in steps of 360 / 19 degrees. Split `yaw`: the drive trains, sides that it did not see are tested."""
    renderer: Literal["embree", "mitsuba"] = "embree"
    """Who makes the colours. embree: a ray caster; mitsuba: path traced, more like photographs, some 20 times as slow
    (extra `photo`). Cameras, light and truth are the same."""
    seed: int = 0
    """The same seed gives the same cars and photos."""
    licence: str | None = None
    """SPDX name put on the patches; CC0-1.0 for generated cars when absent, "unknown" for meshes."""
    workers: int = 0
    """Processes; 0 takes one per core. Changes nothing in the result."""


def frozen_benchmark(out: Path, workers: int = 0) -> SynthConfig:
    """The frozen benchmark set (synthetic/benchmark.py): 64 cars x 8 views, 128 x 128 px, never trained on."""
    return SynthConfig(
        out=out,
        cars=BENCHMARK_CARS,
        views=BENCHMARK_VIEWS,
        size=BENCHMARK_SIZE_PX,
        seed=BENCHMARK_SEED,
        workers=workers,
    )


def synthesize(config: SynthConfig, report: Report = silent) -> BuildSummary:
    """Make the store `config.out`: every photo is kept; the splits are written."""
    start = time.perf_counter()
    _check(config)
    if is_made_already(config.out, asdict(config)):
        clear_leftovers(config.out)
        return summarize(open_store(config.out), source=SOURCE)
    files, renderer = mesh_files(config.meshes), renderer_of(config)
    with StoreWriter(config.out, source=SOURCE, resume_key=_resume_key(config, files, renderer)) as writer:
        write_run(config.out, asdict(config))
        todo = [i for i in range(config.cars) if not all(writer.has(name) for name in patch_ids(config, i))]
        work, workers = partial(car_records, config, files, renderer=renderer), _num_workers(config, len(todo))
        with closing(ordered_map(work, todo, workers=workers)) as photographed:
            for done, records in enumerate(photographed, start=1 + config.cars - len(todo)):
                for record in records:
                    if not writer.has(record.patch_id):
                        writer.append(record)
                report("photograph", done, config.cars, f"{len(writer)} photos")
        judge_and_split(writer, KEEP_ALL)
        if config.tracks:
            store = open_store(config.out, lock=writer.lock)
            store.write_split("yaw", split_by_drive(seen_from(kept_views(store), azimuths_deg(measure(store)))))
    summary = summarize(open_store(config.out), source=SOURCE)
    return replace(summary, seconds=time.perf_counter() - start)


def content_digest(records: Iterable[PatchRecord]) -> str:
    """Sha256 (hexadecimal) over decoded pixels and labels in order: encoders of PNG do not matter."""
    digest = hashlib.sha256()
    for record in records:
        patch = record.decode()
        assert patch.depth_m is not None
        for pixels in (patch.image, patch.mask, np.nan_to_num(patch.depth_m)):
            digest.update(np.ascontiguousarray(pixels).tobytes())
        window = (record.crop_x0, record.crop_y0, record.crop_width, record.crop_height)
        camera = (record.fx, record.fy, record.cx, record.cy)
        box = (record.box_center, record.box_size, record.box_yaw, record.box_rotation)
        digest.update(json.dumps([record.patch_id, window, camera, box]).encode())
    return digest.hexdigest()


def coarse_content(records: Iterable[PatchRecord]) -> list[tuple[float, ...]]:
    """What other processors and library versions reproduce to within rounding; one row of figures per patch.

    Mean colour (rgb, 0-255), car pixels, mean depth (m), focal length (px), box centre and size (m).
    """
    rows = []
    for record in records:
        patch = record.decode()
        assert patch.depth_m is not None
        assert record.box_center is not None
        assert record.box_size is not None
        mean = patch.image.reshape(-1, 3).mean(axis=0).tolist()
        car = patch.mask == MaskValue.CAR
        measured = (*mean, float(car.sum()), float(np.nanmean(patch.depth_m)))
        rows.append((*measured, record.fx, *record.box_center, *record.box_size))
    return rows


def _check(config: SynthConfig) -> None:
    for name, low in (("cars", 1), ("views", 1), ("seed", 0), ("workers", 0)):
        if getattr(config, name) < low:
            raise InputError(f"--{name} must be {low} or more, found {getattr(config, name)}")
    if config.tracks and config.cameras == "phone":
        raise InputError("--tracks are driven past by KITTI's camera; leave --cameras phone out")
    if not MIN_SIZE_PX <= config.size <= MAX_SIZE_PX:
        raise InputError(f"--size must be {MIN_SIZE_PX} to {MAX_SIZE_PX} px, found {config.size}")


def mesh_files(meshes: Path | None) -> list[Path]:
    """The GLB files that --meshes names; none without it."""
    if meshes is None:
        return []
    files = [meshes] if meshes.is_file() else sorted(meshes.glob("*.glb"))
    if not files:
        raise InputError(f"--meshes {meshes}: expected a GLB file or a folder with *.glb, found none")
    for file in files:
        load_glb(file)  # a broken file is told at once, not after minutes
    return files


def renderer_of(config: SynthConfig) -> Renderer:
    """Who makes the colours; `InputError` when an extra for it is missing."""
    if config.renderer == "embree":
        return RayCaster()
    from carstudio.synthetic.mitsuba_renderer import pick_path_tracer

    return pick_path_tracer()


def _resume_key(config: SynthConfig, files: list[Path], renderer: Renderer) -> str:
    """What must be equal for an interrupted run to go on; more cars may be asked for than before."""
    settings = {k: v for k, v in asdict(config).items() if k not in ("out", "workers", "meshes", "cars")}
    if not config.tracks:  # as before there were tracks: an interrupted run of then goes on
        del settings["tracks"]
    settings["renderer"] = renderer.name
    settings["meshes"] = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def _num_workers(config: SynthConfig, num_cars: int) -> int:
    return min(config.workers or os.cpu_count() or 1, max(1, num_cars // 4))  # a process takes seconds to start


def patch_ids(config: SynthConfig, index: int) -> list[str]:
    """Ids of a car's patches: its views (or frames of the drive), then the car turned."""
    car = instance_id(config, index)
    turns = range(1, NUM_TURNS) if config.tracks else ()
    return [f"{car}-{view:03d}" for view in range(config.views)] + [f"{car}-turned-{turn:02d}" for turn in turns]


def instance_id(config: SynthConfig, index: int) -> str:
    """Id of a car."""
    return f"syn-{config.seed}-{index:06d}"


def make_car(config: SynthConfig, files: list[Path], index: int, repaint: Paint | None = None) -> Car:
    """The car of an index: drawn (and repainted where asked), or the mesh whose turn it is."""
    if files:
        return load_glb(files[index % len(files)])
    return draw_car(np.random.default_rng([config.seed, index]), repaint)


def car_records(
    config: SynthConfig,
    files: list[Path],
    index: int,
    renderer: Renderer | None = None,
    repaint: Paint | None = None,
) -> tuple[PatchRecord, ...]:
    """All patches of one car; `renderer` as the config says when it is not given.

    With `repaint` the same photos of the same car in another colour: light, street, cameras and sensors are the same.
    """
    car, renderer = make_car(config, files, index, repaint), renderer or renderer_of(config)
    photographs = _photograph(config, car, index, renderer)
    return tuple(
        _record(config, car, view, photo, patch_id, renderer.name)
        for view, (photo, patch_id) in enumerate(zip(photographs, patch_ids(config, index), strict=True))
    )


def _photograph(config: SynthConfig, car: Car, index: int, renderer: Renderer) -> list[Photograph]:
    seed, views, size = (config.seed, index), config.views, config.size
    if config.tracks:
        return photograph_drive(car, seed=seed, num_frames=views, num_turns=NUM_TURNS, size_px=size, renderer=renderer)
    return draw_photographs(car, seed=seed, num_views=views, size_px=size, cameras=config.cameras, renderer=renderer)


def _record(config: SynthConfig, car: Car, view: int, photo: Photograph, patch_id: str, renderer: str) -> PatchRecord:
    rows, columns = np.nonzero(photo.mask)
    box2d = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    window = crop_window(box2d, config.size, config.size)
    camera, box = photo.viewpoint.camera, photo.viewpoint.box(car.mesh)
    outline = envelope(box, camera)
    assert outline is not None
    image = encode_png(np.ascontiguousarray(photo.image[window.slices]))
    mask = np.where(photo.mask, MaskValue.CAR, MaskValue.BACKGROUND).astype(np.uint8)[window.slices]
    fx, fy, cx, cy = camera.intrinsics.tolist()
    is_upright = photo.viewpoint.kind == "kitti"
    rotation = quaternion_from_rotation(torch.tensor(photo.viewpoint.rotation, dtype=torch.float64))
    car_id = "-".join(patch_id.split("-")[:3])
    is_turned = view >= config.views
    return PatchRecord(
        patch_id=patch_id,
        instance_id=car_id,
        frame_id=patch_id,
        sequence_id=None if is_turned else car_id,
        frame_index=None if is_turned else view,
        source=SOURCE,
        image=image,
        mask=encode_png(np.ascontiguousarray(mask)),
        depth=encode_depth(photo.depth_m[window.slices]),
        frame_path=f"synthetic/{patch_id}",
        frame_width=config.size,
        frame_height=config.size,
        crop_x0=window.x0,
        crop_y0=window.y0,
        crop_width=window.width,
        crop_height=window.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        camera_source="exact",
        box2d=box2d,
        box_center=tuple(photo.viewpoint.translation.tolist()),
        box_size=tuple(car.mesh.size.tolist()),
        box_yaw=float(box.yaw_rad),
        box_rotation=None if is_upright else tuple(rotation.tolist()),
        score_2d=1.0,
        score_mask=1.0,
        score_3d=1.0,
        mask_ratio=float((mask == MaskValue.CAR).mean()),
        box_iou=round(float(box2d_iou(outline, torch.tensor(box2d))), 6),
        truncation=0.0,
        occlusion=0,
        licence=config.licence or ("unknown" if config.meshes else "CC0-1.0"),
        sha256=hashlib.sha256(image).hexdigest(),
        extra=_extra(config, car, photo, renderer, turns=view - config.views + 1 if is_turned else 0),
    )


def _extra(config: SynthConfig, car: Car, photo: Photograph, renderer: str, turns: int) -> str:
    view, light = photo.viewpoint, photo.light
    facts = {
        "style": car.style,
        "paint": None if car.paint is None else car.paint.name,
        "paint_srgb": None if car.paint is None else list(car.paint.srgb),
        "azimuth_deg": round(float(np.degrees(view.azimuth_rad)), 3),
        "elevation_deg": round(float(np.degrees(view.elevation_rad)), 3),
        "camera": view.kind,
        "is_sunny": light.is_sunny,
        "to_sun": [round(float(v), 4) for v in light.to_sun],
        "seed": config.seed,
    }
    if renderer != RayCaster().name:  # photos of the ray caster have no such entry: the frozen benchmark's bytes
        facts["renderer"] = renderer
    if turns:
        facts["turned_deg"] = round(360 * turns / NUM_TURNS, 3)
    return json.dumps(facts, sort_keys=True)
