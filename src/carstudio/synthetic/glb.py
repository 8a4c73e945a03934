"""Car meshes from GLB files: glTF axes (+Y up, +Z front, metres) to the car frame, textures and vertex colours kept."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from carstudio.errors import InputError
from carstudio.images import no_ghostscript
from carstudio.synthetic.cars import Car
from carstudio.synthetic.materials import Material, linear_from_srgb
from carstudio.synthetic.surfaces import NO_CHART, CarMesh, Chart

CAR_FROM_GLTF = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])  # front +Z, up +Y, left +X; a rotation
MAX_EDGE_M = 0.25  # sky light is worked out per vertex
INSIDE = 0.012  # linear grey seen through clear texels
LENGTHS_M = (2.0, 9.0)  # what a car's length may be; anything else is in other units or along another axis


def load_glb(path: Path | str) -> Car:
    """The car of a GLB file; `InputError` when it cannot be read or is no car in metres along +Z."""
    path = Path(path)
    try:
        with no_ghostscript():  # a texture may be anything that Pillow opens
            pieces = _pieces(trimesh.load_scene(path))
    except Exception as error:  # trimesh raises whatever its parsers raise, broken textures when they are looked at
        raise InputError(
            f"{path}: cannot be read as a mesh ({type(error).__name__}: {error}); export it again as GLB"
        ) from error
    if not pieces:
        raise InputError(f"{path}: expected triangles, found none")
    mesh = _join(pieces)
    length, height, width = mesh.size
    if not (LENGTHS_M[0] < length < LENGTHS_M[1] and length > max(width, height)):
        raise InputError(
            f"{path}: expected a car in metres, +Y up and +Z front (glTF), 2 to 9 m long; "
            f"found {length:.2f} x {height:.2f} x {width:.2f} m (length along Z, height, width); scale or turn it"
        )
    return Car(mesh, path.stem, None)


def _pieces(scene: trimesh.Scene) -> list[dict[str, Any]]:
    pieces = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            pieces.append(_piece(geometry, np.asarray(transform)))
    return pieces


def _piece(geometry: trimesh.Trimesh, transform: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    turn = CAR_FROM_GLTF @ transform[:3, :3]
    vertices = geometry.vertices @ turn.T + CAR_FROM_GLTF @ transform[:3, 3]
    normals = geometry.vertex_normals @ np.linalg.inv(turn)
    uv = getattr(geometry.visual, "uv", None)
    uv = np.zeros((len(vertices), 2)) if uv is None else np.asarray(uv, float)
    attributes = np.concatenate([vertices, normals, uv, _vertex_colours(geometry)], axis=1)
    faces = np.asarray(geometry.faces)
    while _longest_edge(attributes[:, :3], faces) > MAX_EDGE_M and len(faces) < 200_000:
        _, faces, extra = trimesh.remesh.subdivide(attributes[:, :3], faces, vertex_attributes={"all": attributes})
        attributes = extra["all"]
    chart, material = _look(geometry)
    return {"attributes": attributes, "faces": faces, "chart": chart, "material": material}


def _longest_edge(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray) -> float:
    corners = vertices[faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max())


def _vertex_colours(geometry: trimesh.Trimesh) -> Float[np.ndarray, "n 3"]:
    """Linear vertex colours; white where the mesh has none. glTF stores them linear."""
    visual = geometry.visual
    if isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        return np.asarray(visual.vertex_colors, float)[:, :3] / 255
    return np.ones((len(geometry.vertices), 3))


def _look(geometry: trimesh.Trimesh) -> tuple[Chart | None, Material]:
    """Texture and material: glTF's metallic-roughness, of which roughness becomes a share of sharp reflection."""
    material = getattr(geometry.visual, "material", None)
    if material is not None and not hasattr(material, "baseColorFactor"):
        material = material.to_pbr()
    factor = getattr(material, "baseColorFactor", None)
    rgb = np.ones(3) if factor is None else np.asarray(factor, float)[:3] / (255 if np.max(factor) > 1 else 1)
    roughness = getattr(material, "roughnessFactor", None)
    gloss = float(np.clip(1 - (0.5 if roughness is None else roughness), 0, 1))
    r, g, b = rgb.tolist()
    image = getattr(material, "baseColorTexture", None)
    chart = None
    if image is not None and getattr(geometry.visual, "uv", None) is not None:
        rgba = np.asarray(image.convert("RGBA"), float) / 255
        texels = linear_from_srgb(rgba[..., :3]) * rgb
        if getattr(material, "alphaMode", None) in ("BLEND", "MASK"):  # windows: one sees the dark inside
            texels = texels * rgba[..., 3:] + INSIDE * (1 - rgba[..., 3:])
        chart = Chart(rgb=np.ascontiguousarray(texels[::-1].transpose(1, 0, 2)).astype(np.float32))
    return chart, Material((r, g, b), 0.04, gloss)


def _join(pieces: list[dict[str, Any]]) -> CarMesh:
    starts = np.cumsum([0] + [len(piece["attributes"]) for piece in pieces])
    attributes = np.concatenate([piece["attributes"] for piece in pieces])
    charts = [piece["chart"] for piece in pieces if piece["chart"] is not None]
    face_chart = []
    for piece in pieces:
        index = NO_CHART if piece["chart"] is None else next(i for i, c in enumerate(charts) if c is piece["chart"])
        face_chart.append(np.full(len(piece["faces"]), index))
    vertices = attributes[:, :3]
    normals = attributes[:, 3:6] / np.maximum(np.linalg.norm(attributes[:, 3:6], axis=1, keepdims=True), 1e-9)
    return CarMesh(
        vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2,
        normals,
        attributes[:, 6:8],
        np.concatenate([piece["faces"] + start for piece, start in zip(pieces, starts, strict=False)]),
        np.concatenate([np.full(len(piece["faces"]), i) for i, piece in enumerate(pieces)]),
        np.concatenate(face_chart),
        tuple(charts),
        tuple(piece["material"] for piece in pieces),
        attributes[:, 8:11],
    )
