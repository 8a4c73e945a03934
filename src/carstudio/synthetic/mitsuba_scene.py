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
LEAST_SPECULAR = 0.02  # of the rough base: what shines is in the coat; without this dark paint looks milky
GROUND_FADE_M = (7.0, 9.5)  # distance from the car at which the plane begins and ends to fade; shadows end before
GROUND_TEXELS = 1024
# Columns of `principled_values`.
RED, GREEN, BLUE, ROUGHNESS, METALLIC, CLEARCOAT = range(6)


def principled_values(materials: tuple[Material, ...]) -> Float[np.ndarray, "materials 6"]:
    """Base colour (linear rgb), roughness, metallic and clearcoat of Mitsuba's principled material for each of ours.

    A clear coat of strength 1 mirrors a quarter of what real lacquer does (Disney's convention), so lacquer of
    reflectance 0.04 gets 4.
    """
    rows = []
    for material in materials:
        is_metal = material.metallic > 0.6  # chrome mirrors by its metal, paint by the lacquer on its flakes
        coat = 0.0 if is_metal else 100 * material.specular * material.mirror
        rough = 0.3 - 0.25 * material.mirror if is_metal else (0.4 if material.mirror > 0.1 else 0.85)
        rows.append((*material.rgb, rough, material.metallic, coat))
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
    table = principled_values(mesh.materials)
    meshes = []
    for index in np.unique(group).tolist():
        faces = np.flatnonzero(group == index)
        if index < 0:
            values, colours = table[-1 - index], mesh.colours
            look = _plain_look(values, has_colours=colours is not None)
            tint = None if colours is None else colours * values[:3]
        else:
            material = int(mesh.face_material[faces[0]])
            look, tint = _chart_look(mi, mesh.charts[index], table, material, is_tiled=not _in_unit(mesh.uv)), None
        meshes.append(_mesh(mi, mesh, faces, {"type": "twosided", "bsdf": look}, tint))
    return meshes


def _in_unit(uv: Float[np.ndarray, "n 2"]) -> bool:
    return bool((uv >= 0).all() and (uv <= 1).all())


def _mesh(
    mi: Any,
    mesh: CarMesh,
    faces: Integer[np.ndarray, " m"],
    look: dict[str, Any],
    colours: Float[np.ndarray, "n 3"] | None,
) -> Any:
    used, corners = np.unique(mesh.faces[faces], return_inverse=True)
    properties = mi.Properties()
    properties["look"] = mi.load_dict(look)
    part = mi.Mesh(
        "car", len(used), len(faces), props=properties, has_vertex_normals=True, has_vertex_texcoords=True
    )
    if colours is not None:
        part.add_attribute("vertex_color", 3, np.ravel(colours[used]).astype(np.float32))
    buffers = mi.traverse(part)
    buffers["vertex_positions"] = np.ravel(mesh.vertices[used]).astype(np.float32)
    buffers["vertex_normals"] = np.ravel(mesh.normals[used]).astype(np.float32)
    buffers["vertex_texcoords"] = np.ravel(mesh.uv[used]).astype(np.float32)
    buffers["faces"] = np.ravel(corners).astype(np.uint32)
    buffers.update()
    return part


def _plain_look(values: Float[np.ndarray, "6"], *, has_colours: bool) -> dict[str, Any]:
    colour: dict[str, Any] = {"type": "rgb", "value": values[:3].tolist()}
    return {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_color"} if has_colours else colour,
        "roughness": float(values[ROUGHNESS]),
        "metallic": float(values[METALLIC]),
        "clearcoat": float(values[CLEARCOAT]),
        "clearcoat_gloss": 1.0,
        "specular": LEAST_SPECULAR,
    }


def _chart_look(
    mi: Any, chart: Chart, table: Float[np.ndarray, "materials 6"], material: int, *, is_tiled: bool
) -> dict[str, Any]:
    """The look of a chart: a finish per texel, each with its own material, or colours of one material."""
    if chart.finish is not None:
        texels = table[chart.finish]
    else:
        assert chart.rgb is not None
        texels = np.broadcast_to(table[material], (*chart.rgb.shape[:2], table.shape[1])).copy()
        texels[..., :3] = chart.rgb

    def texture(columns: slice) -> dict[str, Any]:
        pixels = np.ascontiguousarray(texels[..., columns].transpose(1, 0, 2), np.float32)  # u runs along our rows
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(pixels),
            "raw": True,
            "filter_type": "nearest",
            "wrap_mode": "repeat" if is_tiled else "clamp",
        }

    return {
        "type": "principled",
        "base_color": texture(slice(RED, BLUE + 1)),
        "roughness": texture(slice(ROUGHNESS, ROUGHNESS + 1)),
        "metallic": texture(slice(METALLIC, METALLIC + 1)),
        "clearcoat": texture(slice(CLEARCOAT, CLEARCOAT + 1)),
        "clearcoat_gloss": 1.0,
        "specular": LEAST_SPECULAR,
    }


def _ground(mi: Any, street: Street) -> dict[str, Any]:
    """A square of the street about the car; x of the car frame runs along its texture's columns, z along its rows."""
    reach = GROUND_FADE_M[1]
    at = ((np.arange(GROUND_TEXELS) + 0.5) / GROUND_TEXELS * 2 - 1) * reach
    x, z = np.meshgrid(at, at)
    points = np.stack([x, np.full_like(x, street.ground_y), z], axis=-1).reshape(-1, 3).astype(np.float32)
    colour = np.clip(street.ground_colour(points), 0, 1).reshape(*x.shape, 3)
    opacity = (np.clip((reach - np.hypot(x, z)) / (reach - GROUND_FADE_M[0]), 0, 1) * _between_the_rows(street, points, x.shape))
    transform = mi.ScalarTransform4f(
        [[reach, 0, 0, 0], [0, 0, -1, street.ground_y], [0, reach, 0, 0], [0, 0, 0, 1.0]]
    )

    def texture(pixels: Float[np.ndarray, "rows columns channels"]) -> dict[str, Any]:
        # Row 0 of a texture lies at v = 1 of the square, its far end.
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(pixels, np.float32)), "raw": True}

    diffuse = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(colour)}}
    look = {"type": "mask", "opacity": texture(opacity[..., None]), "bsdf": diffuse}
    return {"type": "rectangle", "to_world": transform, "bsdf": look}


def _between_the_rows(street: Street, points: Float[np.ndarray, "n 3"], shape: tuple[int, ...]) -> Float[np.ndarray, "rows columns"]:
    """1 on the street's side of both rows of houses, 0 behind their walls."""
    _, c = street.to_street(points)
    off = c - street.lane
    inside = (off > -street.half_width - street.row_distance[0]) & (off < street.half_width + street.row_distance[1])
    return inside.reshape(shape).astype(np.float32)


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
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1).astype(np.float32)
