"""A scene for Mitsuba 3 made of ours: the car's meshes with principled materials, the ground, sky, sun and houses.

Everything stays in the car frame (metres, y down). The surroundings are one environment map, seen from the car's
centre: it lights the car and is mirrored in paint and glass. The ground around the car is a real plane, so that it
takes shadows and light from the car; towards its rim it turns transparent, and what lies beyond is not Mitsuba's.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from carstudio.synthetic.background import open_ground_light, radiance
from carstudio.synthetic.light import Light
from carstudio.synthetic.materials import Material
from carstudio.synthetic.shading import Scene
from carstudio.synthetic.street import Street
from carstudio.synthetic.surfaces import NO_CHART, CarMesh, Chart

SKY_COLUMNS, SKY_ROWS = 1024, 512  # 0.35 degrees a texel: houses are still sharp in a door
SUN_WIDTH = 0.0006  # 1 - cos at which the sun's disc has fallen to 1/e: 2 degrees; a real one would need many samples
GROUND_FADE_M = (7.0, 9.5)  # distance from the car at which the plane begins and ends to fade; shadows end before
GROUND_TEXELS = 1024
LACQUER_ROUGHNESS = 0.05  # a mirror to the eye, smooth enough for houses, rough enough to be sampled well
# Columns of `looks`.
BASE, ROUGHNESS, METALLIC, METAL_ROUGHNESS, COAT = slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 6), slice(6, 7)


def looks(materials: tuple[Material, ...]) -> Float[np.ndarray, "materials 7"]:
    """How Mitsuba shows each of our materials: base colour (linear rgb), roughness of the surface, share of metal,
    the metal's roughness, and the clear coat on the metal.

    A clear coat of strength 1 mirrors a quarter of what lacquer does (Disney's convention), so that of paint gets 4.
    """
    rows = []
    for material in materials:
        is_solid = material.metallic > 0.6  # chrome; less is metal flakes below lacquer, or a rim
        roughness = LACQUER_ROUGHNESS if material.mirror > 0.75 else 0.85 - material.mirror
        metal_roughness = 0.3 - 0.25 * material.mirror if is_solid else 0.4
        coat = 0.0 if is_solid else 4 * material.mirror
        rows.append((*material.rgb, roughness, material.metallic, metal_roughness, coat))
    return np.array(rows, np.float32)


def build_scene(mi: Any, scene: Scene) -> Any:
    """The Mitsuba scene of one car, street and light; `mi` is the module with its variant set."""
    parts: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5, "hide_emitters": True},
        "surroundings": {"type": "envmap", "bitmap": mi.Bitmap(environment(scene.street, scene.light))},
        "ground": _ground(mi, scene.street),
    }
    for number, part in enumerate(_car_meshes(mi, scene.tracer.mesh)):
        parts[f"car{number}"] = part
    return mi.load_dict(parts)


def _car_meshes(mi: Any, mesh: CarMesh) -> list[Any]:
    """One mesh for each chart, and for each material of the faces without one."""
    group = np.where(mesh.face_chart == NO_CHART, -1 - mesh.face_material, mesh.face_chart)
    table = looks(mesh.materials)
    meshes = []
    for index in np.unique(group).tolist():
        faces = np.flatnonzero(group == index)
        row = table[-1 - index] if index < 0 else table[mesh.face_material[faces[0]]]
        chart = None if index < 0 else mesh.charts[index]
        has_colours = chart is None and mesh.colours is not None
        made = look(mi, row if chart is None else _texels(chart, table, row), has_colours=has_colours)
        colours = mesh.colours * row[BASE] if has_colours and mesh.colours is not None else None
        meshes.append(_mesh(mi, mesh, faces, made, colours))
    return meshes


def _mesh(
    mi: Any,
    mesh: CarMesh,
    faces: Integer[np.ndarray, " m"],
    material: dict[str, Any],
    colours: Float[np.ndarray, "n 3"] | None,
) -> Any:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    properties = mi.Properties()
    properties["look"] = mi.load_dict(material)
    part = mi.Mesh("car", len(used), len(faces), props=properties, has_vertex_normals=True, has_vertex_texcoords=True)
    if colours is not None:
        part.add_attribute("vertex_color", 3, np.ravel(colours[used]).astype(np.float32))
    buffers = mi.traverse(part)
    buffers["vertex_positions"] = np.ravel(mesh.vertices[used]).astype(np.float32)
    buffers["vertex_normals"] = np.ravel(mesh.normals[used]).astype(np.float32)
    buffers["vertex_texcoords"] = np.ravel(mesh.uv[used]).astype(np.float32)
    buffers["faces"] = np.ravel(corners).astype(np.uint32)
    buffers.update()
    return part


def _texels(
    chart: Chart, table: Float[np.ndarray, "materials 7"], row: Float[np.ndarray, "7"]
) -> Float[np.ndarray, "rows columns 7"]:
    """The look of every texel: a finish each with its own material, or colours of one material."""
    if chart.finish is not None:
        return table[chart.finish]
    assert chart.rgb is not None
    texels = np.broadcast_to(row, (*chart.rgb.shape[:2], len(row))).copy()
    texels[..., BASE] = chart.rgb
    return texels


def look(mi: Any, values: Float[np.ndarray, "*texels 7"], *, has_colours: bool) -> dict[str, Any]:
    """A material from one row of `looks`, or from one for every texel: lacquer or plastic, blended with metal."""

    def of(columns: slice) -> Any:
        if values.ndim == 3:
            return _texture(mi, values[..., columns])
        if columns is not BASE:
            return float(values[columns][0])
        tint = {"type": "mesh_attribute", "name": "vertex_color"}
        return tint if has_colours else {"type": "rgb", "value": values[BASE].tolist()}

    solid = {"type": "principled", "base_color": of(BASE), "roughness": of(ROUGHNESS), "specular": 0.55}
    if not values[..., METALLIC].any():
        return {"type": "twosided", "bsdf": solid}
    metal = {
        "type": "principled",
        "base_color": of(BASE),
        "metallic": 1.0,
        "roughness": of(METAL_ROUGHNESS),
        "clearcoat": of(COAT),
        "clearcoat_gloss": 1.0,
    }
    return {"type": "twosided", "bsdf": {"type": "blendbsdf", "weight": of(METALLIC), "solid": solid, "metal": metal}}


def _texture(mi: Any, texels: Float[np.ndarray, "rows columns channels"]) -> dict[str, Any]:
    """A chart's values as a texture: u runs along our rows, texels are not blended."""
    pixels = np.ascontiguousarray(texels.transpose(1, 0, 2), np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "filter_type": "nearest"}


def _ground(mi: Any, street: Street) -> dict[str, Any]:
    """A square of the street about the car; x of the car frame runs along its texture's columns, z along its rows."""
    reach = GROUND_FADE_M[1]
    at = ((np.arange(2 * GROUND_TEXELS) + 0.5) / GROUND_TEXELS - 1) * reach
    x, z = np.meshgrid(at, at)
    points = np.stack([x, np.full_like(x, street.ground_y), z], axis=-1).reshape(-1, 3).astype(np.float32)
    fade = np.clip((reach - np.hypot(x, z)) / (reach - GROUND_FADE_M[0]), 0, 1) * _between_the_rows(street, points)
    colour = _halved(np.clip(street.ground_colour(points), 0, 1).reshape(*x.shape, 3))  # lane lines get smooth edges
    opacity = _halved(fade[..., None])
    transform = mi.ScalarTransform4f([[reach, 0, 0, 0], [0, 0, -1, street.ground_y], [0, reach, 0, 0], [0, 0, 0, 1.0]])

    def texture(pixels: Float[np.ndarray, "rows columns channels"]) -> dict[str, Any]:
        # Row 0 of a texture lies at v = 1 of the square, its far end.
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32)), "raw": True}

    diffuse = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(colour)}}
    look = {"type": "mask", "opacity": texture(opacity), "bsdf": diffuse}
    return {"type": "rectangle", "to_world": transform, "bsdf": look}


def _between_the_rows(street: Street, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "side side"]:
    """1 on the street's side of both rows of houses, 0 behind their walls; `points` make up a square."""
    _, c = street.to_street(points)
    off, side = c - street.lane, round(len(points) ** 0.5)
    inside = (off > -street.half_width - street.row_distance[0]) & (off < street.half_width + street.row_distance[1])
    return inside.reshape(side, side).astype(np.float32)


def _halved(pixels: Float[np.ndarray, "rows columns channels"]) -> Float[np.ndarray, "half_rows half_columns channels"]:
    rows, columns, channels = pixels.shape
    return pixels.reshape(rows // 2, 2, columns // 2, 2, channels).mean(axis=(1, 3))


def environment(street: Street, light: Light) -> Float[np.ndarray, "rows columns 3"]:
    """Radiance from all around as seen from the car's centre, the sun included, in Mitsuba's layout of directions."""
    directions = environment_directions(SKY_ROWS, SKY_COLUMNS).reshape(-1, 3)
    centre = np.zeros_like(directions)
    rgb = radiance(street, light, centre, directions, open_ground_light(light))
    to_sun = directions @ light.to_sun.astype(np.float32)
    disc = np.exp((to_sun - 1) / SUN_WIDTH) / (2 * np.pi * SUN_WIDTH)
    return (rgb + disc[:, None] * light.sun).reshape(SKY_ROWS, SKY_COLUMNS, 3).astype(np.float32)


def environment_directions(rows: int, columns: int) -> Float[np.ndarray, "rows columns 3"]:
    """Unit directions of an environment map's texels: rows from +y (down, in the car frame) to -y, columns about y."""
    theta = (np.arange(rows) + 0.5) / rows * np.pi
    phi = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1).astype(
        np.float32
    )
