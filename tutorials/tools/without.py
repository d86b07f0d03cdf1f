"""The scene of the demo's file, drawn with one step of splatting changed.

    without.quality(shape=spheres)  # dB, the mean of ten test views
    without.show_changes("13_covariance_fails", {"spheres": {"shape": spheres}})

A change is a dictionary of arguments of `draw`: a function in place of a step, or another value of
one of the renderer's constants.
"""

from functools import cache

import numpy as np

from p4dgs_ref.scenes import load, simulator
from p4dgs_ref.splatting import covariance, projection, render
from p4dgs_ref.splatting.settings import FAST
from p4dgs_ref.training.objective import psnr
from tutorials.tools import figures, show, tour

CAMERA, T = simulator.camera_at(tour.SCENE, *np.radians((60, 26))), 0.3
GAUSSIANS = tour.MODEL.gaussians(T, CAMERA)
OWN = GAUSSIANS.index // tour.MODEL.design.k == figures.THREAD.index
FROM_NEAR = {"xlim": (8, 40), "ylim": (40, 12)}  # the red ball, in pixels of CAMERA


def draw(
    g,
    camera,
    zoom=1,
    shape=lambda s, r: covariance.forward(s, r)[0],  # the covariances in space
    splat=lambda cov2d, z, camera: cov2d,  # changes those in the picture
    depth=lambda x: x[:, 2],  # what splats are sorted by, from places as the camera sees them
    occlusion=True,
    **constants,  # of the renderer
):
    """The picture of Gaussians, and the mean2d and cov2d of their splats in pixels of `camera`."""
    settings, near = FAST._replace(**constants), show.enlarged(camera, zoom)
    settings = settings._replace(blur=settings.blur * zoom**2)
    x, s, r = (a.astype(float) for a in (g.x, g.s, g.r))
    projected, _ = projection.forward(x, shape(s, r), **render.pinhole(near, settings))
    mean2d, cov2d, _, z, visible = projected
    cov2d = splat(cov2d, z, camera)
    a, b, c = cov2d.T
    conic = np.stack([c, -b, a], axis=1) / np.where(visible, a * c - b * b, 1)[:, None]
    splats = mean2d, cov2d, conic, depth(x @ camera.R.T + camera.T), visible
    others = g.alpha, g.color, near, tour.MODEL.background, settings, occlusion, False
    image = render.composite(splats, *others)[0][0]
    return np.clip(image, 0, 1), (mean2d + 0.5) / zoom - 0.5, cov2d / zoom**2


@cache
def test_views():
    """The test views of the scene, each with the Gaussians of the file at its time."""
    views = load.load_scene("bouncing").test
    return [(view, tour.MODEL.gaussians(view.time, view.camera)) for view in views]


def quality(**change):
    """The mean PSNR of the test views (dB)."""
    return np.mean([psnr(draw(g, v.camera, **change)[0], v.image) for v, g in test_views()])


def show_changes(name, changes, zoom=8, view=FROM_NEAR):
    """Draw the scene with each of {title: change}, its quality, and anchor 29 ringed."""
    figure, axes = figures.pyplot().subplots(
        1, len(changes), figsize=(4.2 * len(changes), 4.2), layout="constrained", squeeze=False
    )
    for ax, (title, change) in zip(axes.flat, changes.items()):
        image, mean2d, cov2d = draw(GAUSSIANS, CAMERA, zoom, **change)
        show.picture(ax, image, CAMERA, **view)
        show.ellipses(ax, mean2d[OWN], cov2d[OWN], fc="none", ec=show.OWN, lw=2.5)
        ax.set_title(f"{title}: {quality(**change):.1f} dB")
    figures.show(figure, name)
