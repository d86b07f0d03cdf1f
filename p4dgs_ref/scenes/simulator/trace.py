"""The ray tracer of the simulator: pictures of a described scene, independent of splatting.

It draws the effects that the description lists. An effect that is not listed is not computed:

    translation, rotation, scaling    the motions of the bodies
    texture                           a second colour in a pattern; otherwise one colour
    diffuse                           ambient light and Lambert's cosine; otherwise full light
                                      everywhere
    specular                          a Phong highlight
    view_color                        the highlight moves with the viewer; otherwise it is drawn as
                                      seen from straight above
    view_geometry                     nothing: bodies keep their shape from every side, and only the
                                      Gaussians of a model may change theirs
    occlusion                         the nearest surface hides the others; otherwise their light
                                      adds up
    background                        rays that hit nothing have alpha 0; otherwise they are black
                                      with alpha 1
"""

import numpy as np

from .bodies import HITS, NORMALS, TEXTURES, dot, poses

SAMPLES = 3  # rays along each side of a pixel
UP = np.array([0.0, 0.0, 1.0])


def trace(description, camera, t):
    """Draw one picture [H, W, 4] in float64: straight RGBA in [0, 1].

    Alpha is the share of the rays of a pixel that hit something.
    """
    effects, viewer = description.effects, camera.center
    bodies, directions = description.bodies, rays(camera)
    where = poses(bodies, effects, t)
    hits = np.array([hit(body, where[body.name], viewer, directions) for body in bodies])
    visible = np.isfinite(hits)  # [bodies, rays]
    covered = visible.any(axis=0) if "background" in effects else None
    if "occlusion" in effects:
        visible &= nearest(hits)
    color = np.zeros(directions.shape)
    for body, distance, rows in zip(bodies, hits, map(np.flatnonzero, visible)):
        x = viewer + distance[rows, None] * directions[rows]
        color[rows] += shade(body, where[body.name], x, viewer, description.light, effects)
    return develop(color, covered, camera)


def rays(camera):
    """Return the unit directions [H * W * 9, 3] of all rays, pixel by pixel (Q20)."""
    inside = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    v, u, dv, du = np.meshgrid(
        np.arange(camera.height), np.arange(camera.width), inside, inside, indexing="ij"
    )
    x, y = (u + du - camera.c_x) / camera.f_x, (v + dv - camera.c_y) / camera.f_y
    # R maps world to camera; its transpose maps back
    return unit(np.stack([x, y, np.ones(u.shape)], axis=-1).reshape(-1, 3) @ camera.R)


def unit(v):
    """Return vectors [N, 3] of length 1 in the directions of v."""
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def hit(body, pose, origin, directions):
    """Return the distance to a body along every ray, or infinity if the ray misses it."""
    o, d = (origin - pose.T) @ pose.R / pose.scale, directions @ pose.R / pose.scale
    return HITS[body.shape.kind](body.shape, o, d)


def nearest(hits):
    """Return whether each body is the nearest along each ray [bodies, rays], from the distances."""
    return hits.argmin(axis=0) == np.arange(len(hits))[:, None]


def shade(body, pose, x, viewer, light, effects):
    """Return the colours [M, 3] of a body at points x [M, 3] of its surface."""
    local = (x - pose.T) @ pose.R / pose.scale
    color = np.broadcast_to(body.color, x.shape)
    if body.texture is not None and "texture" in effects:
        # Read just below the surface: a face on the border of cells then has one colour.
        mix = TEXTURES[body.texture.kind](body.texture, local * (1 - 1e-6))[:, None]
        color = (1 - mix) * body.color + mix * body.texture.color
    shiny = body.specular is not None and "specular" in effects
    if not shiny and "diffuse" not in effects:
        return color
    normal = NORMALS[body.shape.kind](body.shape, local) @ pose.R.T
    to_light = unit(
        np.broadcast_to(-light.direction, x.shape) if light.kind == "sun" else light.position - x
    )
    facing = np.maximum(dot(normal, to_light), 0)[:, None]
    if "diffuse" in effects:
        color = diffuse(color, facing, light.ambient)
    if shiny:
        to_viewer = viewer - x if "view_color" in effects else np.broadcast_to(UP, x.shape)
        color = color + specular(body.specular, normal, to_light, facing, unit(to_viewer))
    return color


def diffuse(color, facing, ambient):
    """Return ambient light and Lambert's cosine: a surface facing the light keeps its colour."""
    return color * (ambient + (1 - ambient) * facing)


def specular(material, normal, to_light, facing, to_viewer):
    """Return Phong's white lobe about the mirrored light, only where light falls."""
    mirrored = 2 * facing * normal - to_light
    lobe = np.maximum(dot(mirrored, to_viewer), 0)[:, None] ** material.exponent
    return material.strength * np.where(facing > 0, lobe, 0)


def develop(color, covered, camera):
    """Return the picture: mean colours over the rays that hit something, and their share.

    Without `covered` all rays count and alpha is 1.
    """
    size, n = (camera.height, camera.width), SAMPLES**2
    color = np.clip(color, 0, 1).reshape(*size, n, 3).sum(axis=2)
    if covered is None:
        return np.concatenate([color / n, np.ones((*size, 1))], axis=2)
    count = covered.reshape(*size, n, 1).sum(axis=2)
    return np.concatenate([color / np.maximum(count, 1), count / n], axis=2)
