"""One pixel's journey: from a stored photograph to a ray, a colour and a loss, one line per step.

    ./run python examples/01_one_pixel.py

Makes a store of one synthetic car in a temporary folder (a few seconds), takes the pixel in the middle of its first
photograph and follows it through an untrained `car-nerf-small`. The steps are those of docs/architecture.md.
"""

import tempfile
from pathlib import Path

import torch

from carstudio import open_store
from carstudio.dataset.patch import MaskValue
from carstudio.dataset.pixels import PatchCache
from carstudio.dataset.sources.synthetic import SynthConfig, synthesize
from carstudio.models.car_nerf import CarNeRF
from carstudio.recipes import car_nerf_small
from carstudio.rendering.cones import canonical_gaussians
from carstudio.rendering.encoding import integrated_positional_encoding, octaves
from carstudio.rendering.rays import pixel_rays, to_canonical
from carstudio.rendering.sampling import stratified_edges
from carstudio.rendering.volume import Segments, alpha_from_density, composite
from carstudio.training.batches import patch_batch, stack_boxes
from carstudio.training.losses import training_loss


def show(name: str, value: object, unit: str, where: str) -> None:
    """One line: what it is, its shape, its unit, where it comes from, and the numbers when they are few."""
    if isinstance(value, torch.Tensor):
        shape = "x".join(str(side) for side in value.shape) or "scalar"
        numbers = " ".join(f"{number:.3g}" for number in value.flatten().tolist()) if value.numel() <= 4 else ""
    else:
        shape, numbers = "-", str(value)
    print(f"{name:24s} {shape:12s} {unit:26s} {where:28s} {numbers}")


def main() -> None:
    """Walk."""
    with tempfile.TemporaryDirectory() as folder:
        synthesize(SynthConfig(out=Path(folder) / "cars", cars=1, views=2, size=96, workers=1))
        store = open_store(Path(folder) / "cars")
        patch = PatchCache(store, side_px=64)[store.patch_ids()[0]]

    config = car_nerf_small()
    torch.manual_seed(0)
    model = CarNeRF(config.model)
    height, width = patch.mask.shape
    u, v = width // 2, height // 2

    print(f"{'step':24s} {'shape':12s} {'unit':26s} {'from':28s} value")
    show("photo", patch.rgb, "0-255, crop pixels", "dataset/pixels")
    show("pixel's colour", patch.rgb[v, u], "0-255", "dataset/pixels")
    show("pixel's mask", MaskValue(int(patch.mask[v, u])).name.lower(), "car | background | unknown", "dataset/pixels")
    show("box centre", patch.box.center, "m, camera frame", "geometry/box3d")
    show("box size", patch.box.size, "m, length height width", "geometry/box3d")

    rays = pixel_rays(patch.camera, torch.tensor([[[u + 0.5, v + 0.5]]]))
    show("ray direction", rays.directions, "camera frame, unit length", "rendering/rays")
    show("cone radius", rays.radii, "m per m of distance", "rendering/rays")

    box = stack_boxes([patch.box])
    canonical = to_canonical(rays, box)
    show("canonical direction", canonical.directions, "canonical units per m", "geometry/canonical")
    show("entry, exit", torch.cat([canonical.near, canonical.far]), "m along the ray", "rendering/rays")

    edges = stratified_edges(canonical.near, canonical.far, config.model.sampling.coarse)
    show("interval edges", edges, "m along the ray", "rendering/sampling")
    gaussians = canonical_gaussians(canonical, edges, config.model.sampling.cone_map)
    show("Gaussian means", gaussians.mean, "canonical, in [-1, 1]", "rendering/cones")
    show("Gaussian variances", gaussians.variance, "canonical squared", "rendering/cones")
    frequencies = octaves(config.model.position_frequencies, gaussians.mean)
    encoded = integrated_positional_encoding(gaussians.mean, gaussians.variance, frequencies)
    show("encoding", encoded, "in [-1, 1]", "rendering/encoding")

    latents = model.encode(patch_batch([patch]))
    show("shape code", latents.shape, "normalised", "models/car_nerf")
    show("texture code", latents.texture, "normalised", "models/car_nerf")
    density, rgb = model.query(gaussians, canonical.view_directions, latents)
    show("density", density, "per canonical unit", "models/car_nerf")
    show("colour of samples", rgb, "in [0, 1]", "models/car_nerf")

    length = edges.diff(dim=-1) * canonical.stretch[..., None]
    alpha = alpha_from_density(density, length)
    distance = (edges[..., 1:] + edges[..., :-1]) / 2
    rendering = composite(Segments(distance, distance * rays.directions[..., 2:], alpha, rgb))
    show("rendered colour", rendering.rgb, "in [0, 1]", "rendering/volume")
    show("opacity", rendering.opacity, "in [0, 1]", "rendering/volume")
    show("depth", rendering.depth_m, "m along the camera's axis", "rendering/volume")
    whole = model.render(rays, latents, box)
    assert torch.allclose(whole.rgb, rendering.rgb, atol=1e-6), "model.render takes the same steps"

    is_car = (patch.mask[v, u] == MaskValue.CAR).float()[None, None]
    truth = patch.rgb[v, u].float()[None, None] / 255
    terms = training_loss((rendering,), truth, is_car, canonical.hit, config.loss)
    for name, term in terms.items():
        show(f"loss: {name}", term, "squared error", "training/losses")


if __name__ == "__main__":
    main()
