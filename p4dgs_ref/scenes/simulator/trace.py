"""The simulator's ray tracer: analytic pictures of a described scene, independent of splatting.

It draws the effects that the description lists and no others; what is not listed is not computed:

    translation, rotation, scaling    the bodies' motions; without them a body stays where it is described
    texture       a second colour in a pattern; without it the body's first colour everywhere
    diffuse       ambient plus Lambert; without it full light from everywhere
    specular      a Phong highlight; without it none
    view_color    the highlight moves with the viewer; without it, it is seen from straight above
    view_geometry a body that `faces_camera` turns to the viewer; without it, it stands as described
    occlusion     the nearest surface hides the others; without it the light of all bodies adds up
    background    rays that hit nothing let the background through (alpha 0); without it they are black (alpha 1)
"""

import numpy as np

from . import shapes
from .motion import poses

SAMPLES = 3  # a side: 3 by 3 rays a pixel
UP = np.array([0.0, 0.0, 1.0])


def trace(description, camera, t):
    """Draw one picture.

    Shapes     description (see `description.py`), camera, t -> (H, W, 4) float64, straight RGBA
    Units      colour and alpha in [0, 1]; alpha is the part of a pixel's rays that hit something
    """
    effects, viewer = description.effects, camera.center
    directions = rays(camera)
    where = poses(description.bodies, effects, t, viewer)
    scene = [(body, where[body.name]) for body in description.bodies]
    hits = [hit(body, pose, viewer, directions) for body, pose in scene]

    def light(i, chosen):
        return shade(
            *scene[i],
            viewer + hits[i][chosen, None] * directions[chosen],
            viewer,
            description.light,
            effects,
        )

    color = (nearest if "occlusion" in effects else sum_up)(hits, light, len(directions))
    return develop(
        color, np.isfinite(hits).any(axis=0) if "background" in effects else None, camera
    )


def rays(camera):
    """Unit directions in the world, (H * W * 9, 3), a pixel's rays together; pixel centres are integers (Q20)."""
    inside = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    v, u, dv, du = np.meshgrid(
        np.arange(camera.height), np.arange(camera.width), inside, inside, indexing="ij"
    )
    d = np.stack(
        [(u + du - camera.c_x) / camera.f_x, (v + dv - camera.c_y) / camera.f_y, np.ones(u.shape)],
        axis=-1,
    )
    d = d.reshape(-1, 3) @ camera.R  # R maps world to camera; its transpose maps back
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def hit(body, pose, origin, directions):
    """The distance to a body along every ray, infinity where it is missed."""
    return shapes.HITS[body.shape.kind](
        body.shape, (origin - pose.T) @ pose.R / pose.scale, directions @ pose.R / pose.scale
    )


def nearest(hits, light, n):
    """Occlusion: every ray sees the body that it meets first."""
    color, first = np.zeros((n, 3)), np.argmin(hits, axis=0)
    for i, distance in enumerate(hits):
        chosen = np.flatnonzero((first == i) & np.isfinite(distance))
        color[chosen] = light(i, chosen)
    return color


def sum_up(hits, light, n):
    """No occlusion: every ray sees the sum of all bodies that it meets."""
    color = np.zeros((n, 3))
    for i, distance in enumerate(hits):
        chosen = np.flatnonzero(np.isfinite(distance))
        color[chosen] += light(i, chosen)
    return color


def shade(body, pose, x, viewer, light, effects):
    """The colour of a body at points x of its surface, (M, 3) -> (M, 3)."""
    local = (x - pose.T) @ pose.R / pose.scale
    color = np.broadcast_to(body.color, x.shape)
    if body.texture is not None and "texture" in effects:
        color = textured(body, local)
    shiny = body.specular is not None and "specular" in effects
    if not shiny and "diffuse" not in effects:
        return color
    normal = shapes.NORMALS[body.shape.kind](body.shape, local) @ pose.R.T
    to_light = light_direction(light, x)
    facing = np.maximum(np.einsum("ni,ni->n", normal, to_light), 0)[:, None]
    if "diffuse" in effects:
        color = diffuse(color, facing, light.ambient)
    if shiny:
        color = color + specular(
            body.specular, normal, to_light, facing, to_viewer(x, viewer, effects)
        )
    return color


def textured(body, local):
    """The body's colour and its texture's, mixed; just below the surface, lest a face on a cell's border flicker."""
    mix = shapes.TEXTURES[body.texture.kind](body.texture, local * (1 - 1e-6))[:, None]
    return (1 - mix) * body.color + mix * body.texture.color


def light_direction(light, x):
    """Unit vectors from the surface to the lamp, or against the direction of the sun."""
    to_light = (
        light.position - x if light.kind == "point" else np.broadcast_to(-light.direction, x.shape)
    )
    return to_light / np.linalg.norm(to_light, axis=1, keepdims=True)


def to_viewer(x, viewer, effects):
    """Unit vectors to the viewer; straight up where the colour does not depend on the view."""
    if "view_color" not in effects:
        return np.broadcast_to(UP, x.shape)
    return (viewer - x) / np.linalg.norm(viewer - x, axis=1, keepdims=True)


def diffuse(color, facing, ambient):
    """Lambert's cosine over an even ambient light; both together leave a surface that faces the light as it is."""
    return color * (ambient + (1 - ambient) * facing)


def specular(material, normal, to_light, facing, to_viewer):
    """Phong: a white lobe about the mirrored light, only where light falls."""
    mirrored = 2 * facing * normal - to_light
    lobe = np.maximum(np.einsum("ni,ni->n", mirrored, to_viewer), 0)[:, None] ** material.exponent
    return material.strength * np.where(facing > 0, lobe, 0)


def develop(color, covered, camera):
    """Mean over a pixel's rays: colour over those that `covered` says hit something, alpha their part; None: all."""
    color = np.clip(color, 0, 1).reshape(camera.height, camera.width, SAMPLES**2, 3).sum(axis=2)
    if covered is None:
        return np.concatenate(
            [color / SAMPLES**2, np.ones((camera.height, camera.width, 1))], axis=2
        )
    count = covered.reshape(camera.height, camera.width, SAMPLES**2, 1).sum(axis=2)
    return np.concatenate([color / np.maximum(count, 1), count / SAMPLES**2], axis=2)
