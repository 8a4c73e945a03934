"""Colour along camera rays: the car's paint, glass and trim under sun and sky, the surroundings elsewhere.

Diffuse light is baked per vertex; the sun casts one shadow ray; paint, glass and chrome mirror the surroundings (or the
car itself) along one ray with Schlick's Fresnel term; metal flakes reflect a blurred sky. Linear radiance throughout.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from carstudio.synthetic.background import open_ground_light, radiance
from carstudio.synthetic.baking import Baked, bake
from carstudio.synthetic.light import Colours, Light
from carstudio.synthetic.street import Street, ambient
from carstudio.synthetic.tracing import Hits, Surface, Tracer

CLEAR_COAT_WIDTH = 0.0012  # 1 - cos at which the sun's image in clear coat has fallen to 1/e: about 3 degrees
FLAKE_WIDTH = 0.05  # the same for metal flakes: about 18 degrees
Vectors = Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class Scene:
    """One car in one street under one light, ready to be photographed."""

    tracer: Tracer
    street: Street
    light: Light
    baked: Baked


def prepare_scene(tracer: Tracer, street: Street, light: Light) -> Scene:
    """Bake what all views share."""
    return Scene(tracer, street, light, bake(tracer, street, light))


def shade(scene: Scene, origins: Vectors, directions: Vectors) -> Colours:
    """Radiance along rays (unit directions, car frame)."""
    hits = scene.tracer.first_hits(origins, directions)
    rgb = np.zeros((len(origins), 3), np.float32)
    is_missed = np.ones(len(origins), bool)
    is_missed[hits.ray] = False
    rgb[is_missed] = radiance(
        scene.street, scene.light, origins[is_missed], directions[is_missed], scene.baked.ground_light
    )
    if len(hits.ray):
        rgb[hits.ray] = _shade_car(scene, hits, origins, directions)
    return rgb


def _shade_car(scene: Scene, hits: Hits, origins: Vectors, directions: Vectors) -> Float[np.ndarray, "hit 3"]:
    surface = scene.tracer.surface(hits)
    view = directions[hits.ray]
    points = origins[hits.ray] + hits.distance[:, None] * view
    normal = np.where(((surface.normal * view).sum(-1) > 0)[:, None], -surface.normal, surface.normal)
    points = points + 0.004 * normal
    to_sun = scene.light.to_sun.astype(np.float32)
    facing = np.clip(normal @ to_sun, 0, None)
    lit = np.flatnonzero(facing > 0)
    is_shadowed = scene.tracer.is_occluded(points[lit], np.broadcast_to(to_sun, (len(lit), 3)))
    sun = np.zeros(len(points), np.float32)
    sun[lit[~is_shadowed]] = facing[lit[~is_shadowed]]
    sky = scene.tracer.interpolate(scene.baked.vertex, hits)
    light = sky + sun[:, None] * scene.light.sun
    diffuse = surface.rgb * light / np.pi * (1 - surface.metallic)[:, None]
    return (diffuse + _gloss(scene, surface, normal, points, view, sky, sun > 0)).astype(np.float32)


def _gloss(
    scene: Scene, surface: Surface, normal: Vectors, points: Vectors, view: Vectors, sky: Colours, is_sunlit: np.ndarray
) -> Colours:
    """Mirror image of the surroundings, the sun's image, and the sheen of metal flakes."""
    cosine = np.clip(-(normal * view).sum(-1), 0, 1)
    mirrored = (view + 2 * cosine[:, None] * normal).astype(np.float32)
    fresnel = surface.specular + (1 - surface.specular) * (1 - cosine) ** 5
    to_sun = mirrored @ scene.light.to_sun.astype(np.float32)
    out = np.zeros((len(view), 3), np.float32)
    sharp = np.flatnonzero(surface.mirror > 0.01)
    image = _mirror_image(scene, points[sharp], mirrored[sharp])
    spot = np.exp((to_sun[sharp] - 1) / CLEAR_COAT_WIDTH) / (2 * np.pi * CLEAR_COAT_WIDTH) * is_sunlit[sharp]
    spot = np.minimum(spot, 60.0)
    out[sharp] = (fresnel * surface.mirror)[sharp, None] * (image + spot[:, None] * scene.light.sun)
    flakes = np.flatnonzero(surface.metallic > 0.01)
    wide = np.exp((to_sun[flakes] - 1) / FLAKE_WIDTH) / (2 * np.pi * FLAKE_WIDTH) * is_sunlit[flakes]
    openness = np.minimum(sky[flakes].mean(-1) / (np.pi * scene.light.horizon.mean()) * 1.5, 1.0)
    blurred = ambient(scene.street, scene.light, mirrored[flakes]) * openness[:, None]
    sheen = surface.rgb[flakes] * (blurred + wide[:, None] * scene.light.sun)
    out[flakes] += surface.metallic[flakes, None] * sheen
    return out


def _mirror_image(scene: Scene, points: Vectors, directions: Vectors) -> Colours:
    """Radiance that arrives along mirrored rays: the car itself where it is in the way (lit by the sky only)."""
    rgb = radiance(scene.street, scene.light, points, directions, open_ground_light(scene.light))
    hits = scene.tracer.first_hits(points, directions)
    if len(hits.ray):
        surface = scene.tracer.surface(hits)
        rgb[hits.ray] = surface.rgb * scene.tracer.interpolate(scene.baked.vertex, hits) / np.float32(np.pi)
    return rgb
