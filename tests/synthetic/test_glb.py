"""Foreign meshes: axes, size, texture, and what is told about files that are no cars."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from carstudio.errors import InputError
from carstudio.synthetic.glb import load_glb
from carstudio.synthetic.photographs import picture
from carstudio.synthetic.tracing import Tracer


@pytest.mark.parametrize("name", ["suv", "hatchback", "hatchback_red"])
def test_real_meshes_come_in_metres_front_first(test_data: Path, name: str) -> None:
    path = test_data / "meshes" / f"{name}.glb"
    mesh = load_glb(path).mesh
    low, high = trimesh.load_scene(path).bounds
    assert np.allclose(mesh.size, (high - low)[[2, 1, 0]], atol=1e-6)  # glTF: z front, y up, x left
    assert np.allclose(mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0), 0, atol=1e-9)
    top = mesh.vertices[mesh.vertices[:, 1] < -0.4 * mesh.size[1]]
    assert top[:, 0].mean() < 0.05 * mesh.size[0]  # the roof lies in the middle or behind, the bonnet in front
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.volume > 0  # not inside out


def test_the_texture_is_seen(test_data: Path) -> None:
    """The same car in red and in grey: red over the mask, and tail lamps red on both at the rear."""
    red, grey = (load_glb(test_data / "meshes" / f"{name}.glb") for name in ("hatchback_red", "hatchback"))
    on_red, on_grey = (
        photo.image[photo.mask].astype(float).mean(axis=0)
        for photo in (picture(car, azimuth_deg=40.0, size_px=96) for car in (red, grey))
    )
    assert on_red[0] > 1.35 * on_red[1]  # windows, tyres and reflections are grey
    assert abs(on_grey[0] / on_grey[1] - 1) < 0.15
    rear = picture(grey, azimuth_deg=215.0, size_px=160)
    r, g, b = rear.image[rear.mask].astype(float).T
    front = picture(grey, azimuth_deg=35.0, size_px=160)
    fr, fg, fb = front.image[front.mask].astype(float).T
    assert ((r > 1.6 * g) & (r > 1.6 * b)).sum() > 10 + 3 * ((fr > 1.6 * fg) & (fr > 1.6 * fb)).sum()


def _write(path: Path, mesh: trimesh.Trimesh) -> Path:
    mesh.export(path)
    return path


def test_texture_lookup_and_axes_with_a_painted_box(tmp_path: Path) -> None:
    """A box of 4 x 1.5 x 1.8 m whose vertex colours are (left, up, front): each side shows its own."""
    box = trimesh.creation.box(extents=(1.8, 1.5, 4.0))
    share = (box.vertices - box.bounds[0]) / (box.bounds[1] - box.bounds[0])
    box.visual.vertex_colors = np.column_stack([share * 255, np.full(len(share), 255)]).astype(np.uint8)
    mesh = load_glb(_write(tmp_path / "box.glb", box)).mesh
    assert np.allclose(mesh.size, (4.0, 1.5, 1.8))
    origins = np.array([[0.0, 0, 5], [0.0, -5, 0], [5.0, 0, 0]])  # from the left, from above, from the front
    tracer = Tracer(mesh)
    hits = tracer.first_hits(origins, -origins / 5)
    assert np.allclose(np.diag(tracer.surface(hits).rgb), 1.0, atol=0.02)
    assert np.allclose(tracer.surface(hits).normal, origins / 5, atol=0.6)


def test_files_that_are_no_cars(tmp_path: Path) -> None:
    (tmp_path / "broken.glb").write_bytes(b"not a mesh")
    with pytest.raises(InputError, match=r"broken\.glb.*cannot be read"):
        load_glb(tmp_path / "broken.glb")
    millimetres = _write(tmp_path / "mm.glb", trimesh.creation.box(extents=(1800, 1500, 4000)))
    with pytest.raises(InputError, match="in metres"):
        load_glb(millimetres)
    across = _write(tmp_path / "across.glb", trimesh.creation.box(extents=(4.0, 1.5, 1.8)))
    with pytest.raises(InputError, match="scale or turn"):
        load_glb(across)
