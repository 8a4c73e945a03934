"""Exported cars: axes, metres, ground; splats and meshes read back by other programs' rules and compared."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.special import sph_harm_y

from carstudio.errors import InputError
from carstudio.export.axes import gltf_from_canonical
from carstudio.export.harmonics import directions_around, fitted, harmonics
from carstudio.export.mesh import MeshConfig, Surface, directions, fuse, take_views, write_glb
from carstudio.export.splats import canonical_cloud, metric_splats, read_ply, write_ply
from carstudio.geometry.box3d import Box3D
from carstudio.geometry.orbit import orbit_box, orbit_camera
from carstudio.models.interface import CategoryModel, Latents, render_image
from carstudio.rendering.gaussians.cloud import GaussianCloud
from carstudio.rendering.gaussians.tracing import SplattingConfig, render_cloud
from carstudio.rendering.rays import Rays, image_rays, to_canonical
from carstudio.rendering.volume import Segments
from carstudio.synthetic.glb import CAR_FROM_GLTF

SIZE = torch.tensor([4.4, 1.5, 1.8])


def test_the_axes_are_those_that_meshes_are_read_with() -> None:
    linear, shift = gltf_from_canonical(SIZE)
    for canonical, expected in {
        (1.0, 0.0, 0.0): (0.0, 0.75, 2.2),  # the front: +Z
        (0.0, 1.0, 0.0): (0.0, 0.0, 0.0),  # the ground
        (0.0, 0.0, 1.0): (0.9, 0.75, 0.0),  # the car's left: +X
    }.items():
        np.testing.assert_allclose((linear @ torch.tensor(canonical) + shift).numpy(), expected, atol=1e-6)
    turn = (linear @ torch.diag(2 / SIZE)).numpy()
    np.testing.assert_allclose(turn @ CAR_FROM_GLTF, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1)


@pytest.fixture
def cloud() -> GaussianCloud:
    generator = torch.Generator().manual_seed(0)
    return GaussianCloud(
        mean=torch.rand(1, 40, 3, generator=generator) * 1.4 - 0.7,
        log_scale=torch.rand(1, 40, 3, generator=generator) * 1.5 - 3.5,
        quaternion=torch.nn.functional.normalize(torch.randn(1, 40, 4, generator=generator), dim=-1),
        opacity=torch.rand(1, 40, generator=generator) * 0.9 + 0.05,
        rgb=torch.rand(1, 40, 3, generator=generator) * 0.6 + 0.2,
        tint=torch.randn(1, 40, 3, 3, generator=generator) * 0.1,
    )


def placed(azimuth: float) -> Box3D:
    box = orbit_box(SIZE, azimuth_deg=azimuth, elevation_deg=15.0, distance_m=8.0)
    return Box3D(box.center[None], box.size[None], box.rotation[None])


def picture(cloud: GaussianCloud, azimuth: float) -> torch.Tensor:
    rays = image_rays(orbit_camera(32))
    return render_cloud(cloud, rays, to_canonical(rays, placed(azimuth)), SplattingConfig()).rgb[0]


def read_back(path: Path, azimuth: float) -> GaussianCloud:
    """The file's cloud in the colours that the camera of `picture` sees."""
    eye = to_canonical(image_rays(orbit_camera(8)), placed(azimuth)).origins[0, 0]
    linear, shift = gltf_from_canonical(SIZE)
    return canonical_cloud(read_ply(path), SIZE, linear @ eye + shift)


@pytest.mark.parametrize("changes", [False, True])
def test_splats_read_back_render_the_same(tmp_path: Path, cloud: GaussianCloud, changes: bool) -> None:
    """To the bit of a colour where colours are the same from everywhere, else as far as harmonics go."""
    light = torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(2)) * 0.15
    cloud = replace(cloud, light=light) if changes else replace(cloud, tint=None)
    write_ply(tmp_path / "car.ply", metric_splats(cloud, SIZE))
    for azimuth in (20.0, 100.0, 200.0, 300.0):
        again = read_back(tmp_path / "car.ply", azimuth)
        torch.testing.assert_close(again.covariance().matrix(), cloud.covariance().matrix(), rtol=2e-4, atol=1e-6)
        error = picture(again, azimuth) - picture(cloud, azimuth)
        assert float(error.abs().max()) < (0.06 if changes else 2e-4)
        assert float(error.square().mean().sqrt()) < 0.004
    if changes:
        flat = read_back(tmp_path / "car.ply", 20.0)
        assert float((picture(flat, 200.0) - picture(cloud, 200.0)).square().mean().sqrt()) > 0.012  # another side's
    other = GaussianCloud(cloud.mean.flip(-1), cloud.log_scale, cloud.quaternion, cloud.opacity, cloud.rgb)
    assert float((picture(other, 20.0) - picture(cloud, 20.0)).abs().max()) > 0.05  # the comparison can fail


def test_the_file_is_what_splat_viewers_expect(tmp_path: Path, cloud: GaussianCloud) -> None:
    """Read by hand: names in order, logit, logarithm, harmonic, quaternion; metric covariance by brute force."""
    write_ply(tmp_path / "car.ply", metric_splats(cloud, SIZE))
    head, _, body = (tmp_path / "car.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.split(b"\n") if line.startswith(b"property float")]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:17] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names[17:] == [f"f_rest_{i}" for i in range(45)]
    row = dict(zip(names, struct.unpack("<62f", body[: 62 * 4]), strict=True))
    mean, half = cloud.mean[0, 0].numpy(), SIZE.numpy() / 2
    expected = [mean[2] * half[2], -mean[1] * half[1] + half[1], mean[0] * half[0]]
    np.testing.assert_allclose([row["x"], row["y"], row["z"]], expected, rtol=1e-5)
    assert 1 / (1 + np.exp(-row["opacity"])) == pytest.approx(float(cloud.opacity[0, 0]), rel=1e-4)
    assert 0.5 + 0.28209479 * row["f_dc_1"] == pytest.approx(float(cloud.rgb[0, 0, 1]), abs=0.02)
    w, x, y, z = (row[f"rot_{i}"] for i in range(4))
    turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    covariance = turn @ np.diag(np.exp([2 * row[f"scale_{i}"] for i in range(3)])) @ turn.T
    linear = gltf_from_canonical(SIZE)[0].numpy()
    np.testing.assert_allclose(
        covariance, linear @ cloud.covariance().matrix()[0, 0].numpy() @ linear.T, rtol=1e-3, atol=1e-6
    )


def test_colours_as_viewers_compute_them(tmp_path: Path, cloud: GaussianCloud) -> None:
    """All sixteen terms written out with the numbers that viewers have, against our colour for a camera far away."""
    light = torch.randn(1, 9, 3, generator=torch.Generator().manual_seed(2)) * 0.15
    cloud = replace(cloud, light=light)
    write_ply(tmp_path / "car.ply", metric_splats(cloud, SIZE))
    head, _, body = (tmp_path / "car.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1].decode() for line in head.split(b"\n") if line.startswith(b"property float")]
    table = np.frombuffer(body, "<f4").reshape(40, len(names))
    linear = gltf_from_canonical(SIZE)[0]
    errors = []
    for direction in ([0.6, 0.0, 0.8], [-0.5, -0.3, 0.6], [0.1, -0.2, -0.9], [0.7, -0.6, -0.3]):
        x, y, z = (np.array(direction) / np.linalg.norm(direction)).tolist()
        basis = [0.28209479177387814, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
        basis += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
        basis += [0.31539156525252005 * (2 * z * z - x * x - y * y)]
        basis += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]
        basis += [-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z]
        basis += [-0.4570457994644658 * y * (4 * z * z - x * x - y * y)]
        basis += [0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y)]
        basis += [-0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y)]
        basis += [-0.5900435899266435 * x * (x * x - 3 * y * y)]
        seen = []
        for channel in range(3):
            terms = [f"f_dc_{channel}", *(f"f_rest_{15 * channel + term}" for term in range(15))]
            seen.append(sum(b * table[:, names.index(term)] for b, term in zip(basis, terms, strict=True)) + 0.5)
        eye = -100 * torch.linalg.inv(linear) @ torch.tensor([x, y, z])
        ours = cloud.colour_from(eye[None])[0].numpy()
        errors.append(np.sqrt(((np.clip(np.stack(seen, axis=1), 0, 1) - ours) ** 2).mean()))
        assert errors[-1] < 0.25 * np.sqrt(((cloud.rgb[0].numpy() - ours) ** 2).mean())  # the right way round
    assert max(errors) < 0.035


def test_harmonics_are_orthonormal_and_those_of_the_textbooks() -> None:
    directions = directions_around(20_000)
    products = harmonics(directions).mT @ harmonics(directions) * (4 * np.pi / len(directions))
    assert float((products - torch.eye(16)).abs().max()) < 1e-3
    x, y, z = directions[:50].T.numpy()
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    for term in range(16):
        degree = int(np.sqrt(term))
        order = term - degree * degree - degree
        complex_ = sph_harm_y(degree, abs(order), polar, azimuth)  # with the Condon-Shortley phase (-1)^m
        part = complex_.real if order == 0 else np.sqrt(2) * (complex_.imag if order < 0 else complex_.real)
        np.testing.assert_allclose(harmonics(directions[:50])[:, term].numpy(), part, atol=1e-12)


def test_a_fit_finds_coefficients_again() -> None:
    directions = torch.stack([directions_around(200).roll(number, dims=0) for number in range(5)], dim=1)
    truth = torch.randn(5, 3, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values = torch.einsum("dsk,sck->dsc", harmonics(directions), truth)
    weights = torch.rand(200, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.01
    torch.testing.assert_close(fitted(directions, weights, values), truth)


def test_other_files_are_refused(tmp_path: Path, cloud: GaussianCloud) -> None:
    file = tmp_path / "a.ply"
    for content in (b"", b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n"):
        file.write_bytes(content)
        with pytest.raises(InputError, match="expected a binary splat PLY"):
            read_ply(file)
    write_ply(file, metric_splats(cloud, SIZE))
    file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(InputError, match="or cut off"):
        read_ply(file)
    with pytest.raises(InputError, match="cannot be read"):
        read_ply(tmp_path / "absent.ply")


class Ellipsoid(CategoryModel):
    """An opaque ellipsoid that fills the box, its front half red, its left half also green."""

    def trace_levels(
        self, rays: Rays, latents: Latents, box: Box3D, generator: torch.Generator | None = None
    ) -> tuple[Segments, ...]:
        canonical = to_canonical(rays, box)
        o, d = canonical.origins, canonical.directions
        a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - 1
        root = b * b - a * c
        t = (-b - root.clamp(min=0).sqrt()) / a
        at = o + t[..., None] * d
        rgb = torch.stack([(at[..., 0] > 0).float(), (at[..., 2] > 0).float(), torch.zeros_like(t)], dim=-1)
        alpha = (root > 0).float() * 0.999999
        return (Segments(t[..., None], (t * rays.directions[..., 2])[..., None], alpha[..., None], rgb[..., None, :]),)


@pytest.fixture(scope="module")
def surface() -> Surface:
    latents = Latents(torch.zeros(1, 1), torch.zeros(1, 1))
    return fuse(take_views(Ellipsoid(), latents, SIZE, MeshConfig(views=36, view_px=96)), SIZE, 64)


def test_the_mesh_is_the_surface_that_was_seen(surface: Surface) -> None:
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * float(SIZE.prod()) / 8, rel=0.06)  # positive: faces outwards
    above = surface.vertices[surface.vertices[:, 1] < 0.3]  # nobody looked from below
    radius = np.linalg.norm(above / (SIZE.numpy() / 2), axis=1)
    assert np.abs(radius - 1).mean() < 0.02
    assert np.abs(radius - 1).max() < 0.15


def test_the_mesh_has_the_colours_that_were_seen(surface: Surface) -> None:
    clear = (
        (np.abs(surface.vertices[:, 0]) > 0.15) & (np.abs(surface.vertices[:, 2]) > 0.15) & (surface.vertices[:, 1] < 0)
    )
    for channel, axis in ((0, 0), (1, 2)):
        expected = surface.vertices[clear, axis] > 0
        assert np.abs(surface.rgb[clear, channel] - expected).mean() < 0.03


def test_the_glb_stands_on_the_ground_with_its_front_to_z(surface: Surface, tmp_path: Path) -> None:
    write_glb(tmp_path / "car.glb", surface, SIZE, "c-1")
    data = (tmp_path / "car.glb").read_bytes()
    length = struct.unpack("<I", data[12:16])[0]
    described = json.loads(data[20 : 20 + length])
    assert described["asset"]["version"] == "2.0"
    assert "COLOR_0" in described["meshes"][0]["primitives"][0]["attributes"]
    mesh = trimesh.load(tmp_path / "car.glb", force="mesh")
    low, high = mesh.bounds
    np.testing.assert_allclose(high - low, [1.8, 1.5, 4.4], atol=0.12)
    assert low[1] == pytest.approx(0, abs=0.06)
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3]
    front, left = mesh.vertices[:, 2] > 0.3, mesh.vertices[:, 0] > 0.3
    assert colours[front, 0].mean() > 200 > 60 > colours[mesh.vertices[:, 2] < -0.3, 0].mean()
    assert colours[left, 1].mean() > 200 > 60 > colours[mesh.vertices[:, 0] < -0.3, 1].mean()


def test_an_empty_model_gives_no_mesh() -> None:
    class Nothing(Ellipsoid):
        def trace_levels(self, *args: object, **more: object) -> tuple[Segments, ...]:
            (found,) = super().trace_levels(*args, **more)  # type: ignore[arg-type]  # handed through
            return (Segments(found.distance_m, found.depth_m, found.alpha * 0, found.rgb),)

    latents = Latents(torch.zeros(1, 1), torch.zeros(1, 1))
    views = take_views(Nothing(), latents, SIZE, MeshConfig(views=6, view_px=32))
    with pytest.raises(InputError, match="the model shows no car here"):
        fuse(views, SIZE, 16)


def test_views_are_spread_over_the_upper_sphere() -> None:
    places = directions(200)
    elevation = np.array([place[1] for place in places])
    assert -15 < elevation.min() < -10
    assert elevation.max() > 80
    height = np.sin(np.radians(elevation))
    assert np.histogram(height, bins=5)[0].tolist() == [40] * 5  # equal areas, equal numbers


def test_the_ellipsoid_itself_is_right() -> None:
    box = orbit_box(SIZE, azimuth_deg=0.0, elevation_deg=0.0, distance_m=8.0)
    batch = Box3D(box.center[None], box.size[None], box.rotation[None])
    image = render_image(Ellipsoid(), orbit_camera(33), Latents(torch.zeros(1, 1), torch.zeros(1, 1)), batch)
    assert float(image["depth_m"][16, 16]) == pytest.approx(8.0 - 2.2, abs=0.01)
    assert image["rgb"][16, 10].round().tolist() != image["rgb"][16, 22].round().tolist()
