"""What one training step sees: patches to encode, pixels to explain. All randomness comes from (seed, step).

The sampler has no state: the patches of step k are found from the seed alone, so a run resumes in mid-epoch exactly.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache, PreparedPatch, mirror_patch
from carstudio.dataset.store import PatchStore
from carstudio.errors import InputError
from carstudio.geometry.box3d import Box3D, displaced_box
from carstudio.geometry.camera import Camera
from carstudio.models.interface import PatchBatch
from carstudio.rendering.gaussians.tiles import TILE_PX
from carstudio.rendering.rays import Rays, pixel_rays

Supervision = Literal["single-view", "multi-view", "mixed"]
Mirroring = Literal["off", "together", "apart", "apart-where-alone"]
PixelDraws = Literal["anywhere", "in-cells"]
# Standard deviations of labelled boxes' errors: place (share of the size), heading (degrees), size (share)
PLACE_NOISE, HEADING_NOISE_DEG, SIZE_NOISE = 0.03, 3.0, 0.03
_STREAMS = {"epoch": 1, "target": 2, "pixels": 3, "jitter": 4, "mirror": 5, "box": 6}


def generator_for(seed: int, step: int, stream: str, row: int = 0) -> torch.Generator:
    """A CPU generator for one purpose of one step (and one row of its batch); none of them share numbers."""
    mixed = seed * 0x9E3779B97F4A7C15 + step * 0xBF58476D1CE4E5B9 + _STREAMS[stream] * 0x94D049BB133111EB
    return torch.Generator().manual_seed((mixed + row * 0xD6E8FEB86659FD93) % 2**63)


def training_patches(
    store: PatchStore, *, split: str | None, most_cars: int | None = None, least_views: int = 1
) -> dict[str, str]:
    """patch_id -> instance_id of the kept patches to train on, in store order; `InputError` when there are none.

    `most_cars` takes the cars whose ids have the smallest hashes: 100 cars are among 300 of the same store. Cars with
    fewer than `least_views` photos are left out before.
    """
    kept = set(store.patch_ids(kept=True, split=split, part="train" if split else "all"))
    table = store.table(["patch_id", "instance_id"])
    pairs = zip(table["patch_id"].to_pylist(), table["instance_id"].to_pylist(), strict=True)
    found = {patch_id: instance_id for patch_id, instance_id in pairs if patch_id in kept}
    views = Counter(found.values())
    cars = sorted(
        (car for car, count in views.items() if count >= least_views),
        key=lambda car: hashlib.sha256(car.encode()).hexdigest(),
    )
    chosen = set(cars[:most_cars])
    if not chosen:
        which = f" of cars with {least_views} or more photos" if least_views > 1 else ""
        raise InputError(f"{store.path}: no kept patch{which} in the training part of split {split!r}")
    return {patch_id: car for patch_id, car in found.items() if car in chosen}


@dataclass(frozen=True)
class PixelBatch:
    """Rays through pixels of target patches and what was photographed there.

    `alpha` is 1 on the car; `is_known` is False where the mask says unknown: such pixels take part in no loss.
    """

    rays: Rays
    box: Box3D
    rgb: Float[Tensor, "batch ray 3"]
    alpha: Float[Tensor, "batch ray"]
    is_known: Bool[Tensor, "batch ray"]

    def to(self, device: torch.device | str) -> "PixelBatch":
        """The same pixels on another device."""
        moved = (self.rgb.to(device), self.alpha.to(device), self.is_known.to(device))
        return PixelBatch(self.rays.to(device), self.box.to(device), *moved)


def patch_batch(patches: list[PreparedPatch]) -> PatchBatch:
    """Stack prepared patches for the encoder."""
    side = patches[0].encoder_camera.width
    intrinsics = torch.stack([patch.encoder_camera.intrinsics for patch in patches])
    return PatchBatch(
        image=torch.stack([patch.encoder_image for patch in patches]).float() / 255,
        mask=torch.stack([patch.encoder_mask for patch in patches]).float() / 255,
        camera=Camera(intrinsics, side, side),
        box=stack_boxes([patch.box for patch in patches]),
        instance_ids=tuple(patch.instance_id for patch in patches),
    )


def noisy_box(box: Box3D, amount: float, generator: torch.Generator) -> Box3D:
    """A box as rough as labels and detectors give it: errors are normal, of 0 to 2 `amount` usual standard deviations.

    How rough a box is differs from box to box, so a model meets exact ones too.
    """
    scale = 2 * amount * torch.rand(1, generator=generator)
    draws = torch.randn(7, generator=generator) * scale
    turn = math.radians(HEADING_NOISE_DEG) * draws[3]
    return displaced_box(box, PLACE_NOISE * draws[:3], turn, torch.exp(SIZE_NOISE * draws[4:]))


def stack_boxes(boxes: list[Box3D]) -> Box3D:
    """A batch of boxes from single ones."""
    return Box3D(
        torch.stack([box.center for box in boxes]),
        torch.stack([box.size for box in boxes]),
        torch.stack([box.rotation for box in boxes]),
    )


def pixel_batch(
    patches: list[PreparedPatch],
    rays_per_patch: int,
    generators: torch.Generator | Sequence[torch.Generator],
    draws: PixelDraws = "anywhere",
) -> PixelBatch:
    """Pixels drawn evenly, with replacement, from the whole crop of each patch (patches of any size will do).

    By one generator in turn, or by one for each patch, so that a patch's pixels do not depend on the others.
    "in-cells" draws the same means with less noise: one pixel from each of n x n equal cells, the rest anywhere.
    """
    each = [generators] * len(patches) if isinstance(generators, torch.Generator) else generators
    positions, rgb, mask = [], [], []
    for patch, generator in zip(patches, each, strict=True):
        height, width = patch.mask.shape
        picked = _picked(height, width, rays_per_patch, generator, draws)
        positions.append(torch.stack([picked % width, picked // width], dim=-1).float() + 0.5)
        rgb.append(patch.rgb.view(-1, 3)[picked])
        mask.append(patch.mask.view(-1)[picked])
    intrinsics = torch.stack([patch.camera.intrinsics for patch in patches])
    values = torch.stack(mask)
    return PixelBatch(
        rays=pixel_rays(Camera(intrinsics, 0, 0), torch.stack(positions)),
        box=stack_boxes([patch.box for patch in patches]),
        rgb=torch.stack(rgb).float() / 255,
        alpha=(values == MaskValue.CAR).float(),
        is_known=values != MaskValue.UNKNOWN,
    )


def _picked(height: int, width: int, count: int, generator: torch.Generator, draws: PixelDraws) -> Int[Tensor, " ray"]:
    """Numbers of drawn pixels, counted row by row; those of cells in 4 x 4 tiles of cells where they fill such."""
    cells = math.isqrt(count) if draws == "in-cells" else 0
    anywhere = torch.randint(height * width, (count - cells**2,), generator=generator)
    if not cells:
        return anywhere
    drawn = torch.rand(2, cells, cells, generator=generator)
    numbers = torch.arange(cells)
    row = ((numbers[:, None] + drawn[0]) * (height / cells)).long().clamp(max=height - 1)
    column = ((numbers + drawn[1]) * (width / cells)).long().clamp(max=width - 1)
    return torch.cat([_by_tiles(row * width + column), anywhere])


def _by_tiles(cells: Int[Tensor, "row column"]) -> Int[Tensor, " cell"]:
    """Tile by tile, so that rays that follow each other lie together; row by row where the tiles do not fit."""
    if len(cells) % TILE_PX:
        return cells.flatten()
    return cells.unflatten(0, (-1, TILE_PX)).unflatten(2, (-1, TILE_PX)).transpose(1, 2).flatten()


class StepSampler:
    """Which patches a step encodes and which it explains.

    Every patch is encoded once per epoch. `single-view` explains the encoded patch itself (the paper); `multi-view`
    another patch of the same car where it has one; `mixed` either with equal chance.

    Mirroring shows photos flipped left to right half of the time (a car is symmetric): encoded and explained patch
    `together`, or each by its own draw, so that a flipped photo `apart` from the encoded one is a second view of it;
    `apart-where-alone` does so with cars of a single photo, which no other photo explains.
    `box_noise` makes the boxes of encoded patches rough (`noisy_box`); those that are explained stay as they are.
    """

    def __init__(
        self,
        cache: PatchCache,
        patch_ids: list[str],
        *,
        patches_per_step: int,
        supervision: Supervision,
        seed: int,
        mirroring: Mirroring = "off",
        box_noise: float = 0.0,
        pixels: PixelDraws = "anywhere",
    ) -> None:
        assert patch_ids, "no patches to train on"
        self.mirroring, self.box_noise, self.pixels = mirroring, box_noise, pixels
        self.cache, self.patch_ids, self.seed = cache, patch_ids, seed
        self.patches_per_step, self.supervision = patches_per_step, supervision
        table = cache.store.table(["patch_id", "instance_id"])
        instance_of = dict(zip(table["patch_id"].to_pylist(), table["instance_id"].to_pylist(), strict=True))
        self._instance_of = {patch_id: instance_of[patch_id] for patch_id in patch_ids}
        self._views: dict[str, list[str]] = {}
        for patch_id in patch_ids:
            self._views.setdefault(self._instance_of[patch_id], []).append(patch_id)
        self._epoch = -1
        self._order: list[int] = []

    def input_ids(self, step: int) -> list[str]:
        """Patches that step `step` encodes; steps run on over the ends of epochs."""
        first = step * self.patches_per_step
        return [self._at(position) for position in range(first, first + self.patches_per_step)]

    def _at(self, position: int) -> str:
        epoch, place = divmod(position, len(self.patch_ids))
        if epoch != self._epoch:
            generator = generator_for(self.seed, epoch, "epoch")
            self._order, self._epoch = torch.randperm(len(self.patch_ids), generator=generator).tolist(), epoch
        return self.patch_ids[self._order[place]]

    def target_ids(self, step: int, input_ids: list[str]) -> list[str]:
        """The patch that each encoded patch must explain."""
        if self.supervision == "single-view":
            return input_ids
        generator = generator_for(self.seed, step, "target")
        return [self._target(patch_id, torch.rand(2, generator=generator).tolist()) for patch_id in input_ids]

    def _target(self, patch_id: str, draws: list[float]) -> str:
        others = [view for view in self._views[self._instance_of[patch_id]] if view != patch_id]
        if not others or (self.supervision == "mixed" and draws[0] < 0.5):
            return patch_id
        return others[int(draws[1] * len(others))]

    def mirrored(self, step: int) -> list[tuple[bool, bool]]:
        """Whether encoded and explained patch of each pair are flipped."""
        if self.mirroring == "off":
            return [(False, False)] * self.patches_per_step
        draws = torch.rand(self.patches_per_step, 2, generator=generator_for(self.seed, step, "mirror")) < 0.5
        second = 0 if self.mirroring == "together" else 1
        flips = [(bool(row[0]), bool(row[second])) for row in draws]
        if self.mirroring == "apart-where-alone":
            shown = self.input_ids(step)
            flips = [pair if self._is_alone(shown[row]) else (False, False) for row, pair in enumerate(flips)]
        return flips

    def _is_alone(self, patch_id: str) -> bool:
        return len(self._views[self._instance_of[patch_id]]) == 1

    def batch(self, step: int, rays_per_patch: int, rows: range | None = None) -> tuple[PatchBatch, PixelBatch]:
        """Everything step `step` needs, or some rows of it: the same whoever else takes the others."""
        rows = range(self.patches_per_step) if rows is None else rows
        inputs = self.input_ids(step)
        targets = self.target_ids(step, inputs)
        flips = self.mirrored(step)
        shown = [self._patch(inputs[row], flips[row][0]) for row in rows]
        if self.box_noise:
            shown = [
                replace(patch, box=noisy_box(patch.box, self.box_noise, generator_for(self.seed, step, "box", row)))
                for row, patch in zip(rows, shown, strict=True)
            ]
        explained = [self._patch(targets[row], flips[row][1]) for row in rows]
        generators = [generator_for(self.seed, step, "pixels", row) for row in rows]
        return patch_batch(shown), pixel_batch(explained, rays_per_patch, generators, self.pixels)

    def _patch(self, patch_id: str, is_mirrored: bool) -> PreparedPatch:
        return mirror_patch(self.cache[patch_id]) if is_mirrored else self.cache[patch_id]
