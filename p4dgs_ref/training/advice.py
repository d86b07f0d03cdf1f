"""Warnings before a training that cannot learn or be repeated, and after one that did not learn.

Each function returns a sentence, or "" where there is nothing to say.
"""

import numpy as np

from .. import effects as fx
from ..arithmetic import other_kernels
from ..messages import number_of
from ..splatting import render
from ..splatting.settings import FAST
from .initial import lattice_nodes, starting_points
from .objective import psnr

FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
FAR = 10  # times the radius that holds nine tenths of the points
DIFFERENCE = 0.1  # two pixels disagree where a channel differs by more
# The mean of the training pictures has a squared error. This is the least share of it that a model
# must remove. On four scenes of moving bodies, two seeds each, models removed 0.84 to 0.95, the
# same with half of every body cut off 0 to 0.33, with half transparent bodies 0.44 to 0.67; on a
# fifth, in which hardly anything moved, 0.66 and 0.71.
MIN_SHARE = 0.6


def before(scene, preset, seed, points=None):
    """The warnings before a training."""
    told = few_views(scene), empty_pictures(scene), odd_points(scene, preset, seed, points)
    return [*filter(None, (*told, other_kernels()))]


def few_views(scene):
    """A warning of too few training views to show how the scene looks from elsewhere."""
    if len(scene.train) >= FEW_VIEWS:
        return ""
    return (
        f"scene {scene.name}: {number_of(len(scene.train), 'training view')}; views that were not "
        f"trained on will be poor with fewer than {FEW_VIEWS}; 48 are enough for packaged scenes"
    )


def empty_pictures(scene):
    """A warning of pictures that show hardly more than one colour."""
    views = [*scene.train, *scene.test]
    empty = sum(np.ptp(view.image.T.copy(), axis=(1, 2)).max() <= DIFFERENCE for view in views)
    if not empty:
        return ""
    return (
        f"scene {scene.name}: {empty} of {number_of(len(views), 'picture')} show hardly more than "
        "one colour; good figures on these mean nothing"
    )


def odd_points(scene, preset, seed, points):
    """A warning of points to start from that merge or lie far off, or that cameras do not see."""
    points = scene.points if points is None else points
    # The training draws the same points from this seed.
    points = starting_points(points, preset.anchors, preset.extent, np.random.default_rng(seed))
    unseen = points  # most leave at the first cameras, so that many points take little time
    for camera in (view.camera for view in scene.train):
        # points as Gaussians without a size, so that their rotations do not matter
        mean2d, *_, visible = render.project(
            unseen, 0 * unseen, np.ones((len(unseen), 4)), camera, FAST
        )[0]
        shares = (mean2d + 0.5) / (camera.width, camera.height)  # of the picture, from its corner
        unseen = unseen[~(visible & ((shares >= 0) & (shares <= 1)).all(axis=1))]
    middle = np.median(points, axis=0)
    reach, away = np.abs(points - middle).max(axis=1), np.abs(scene.center - middle).max()
    far = np.sum(reach > FAR * np.quantile(reach, 0.9))
    counts = {
        f"sharing the voxel of another, so that they merge (voxel {preset.voxel:g})": (
            len(points) - len(lattice_nodes(points, preset))
        ),
        "outside every training view": len(unseen),
        f"more than {FAR} times as far from their middle as nine tenths of them": far,
    }
    # A tenth of the points may merge or be unseen.
    if max(counts.values()) <= len(points) / 10 and not far and away <= reach.max():
        return ""
    told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return (
        f"scene {scene.name}: of {number_of(len(points), 'starting point')}, "
        f"{told or 'all are seen'}; cameras look {away:.3g} from their middle, they reach "
        f"{reach.max():.3g}; check units"
    )


def after(trainer):
    """A warning of a model that draws nothing, or hardly more than one picture for all views.

    This picture is the mean of the training views. Where a scene moves, both are compared in the
    pixels that disagree with the model at rest, the median of its own pictures over nine times;
    otherwise in all pixels. The views are test views, which training has not seen, or training
    views where a scene has no others.
    """
    model, scene = trainer.model(), trainer.scene
    views, mean = scene.test or scene.train, np.mean([v.image for v in scene.train], axis=0)
    views = views[:: 1 + len(views) // 20]  # 10 to 20 of many
    if not any(len(model.gaussians(v.time, v.camera).alpha) for v in views):
        return (
            f"scene {scene.name}: the model draws nothing: every child is masked (min_opacity="
            f"{trainer.preset.min_opacity:g}) or below tau_alpha={trainer.preset.tau_alpha:g}"
        )
    # The median of the pictures at nine times shows the model at rest.
    times, pixels = np.quantile([v.time for v in scene.train], np.linspace(0, 1, 9)), []
    if not fx.moves(scene.effects) or not np.ptp(times):
        times = ()
    for v in views:
        drawn, *others = (model.render(v.camera, t, trainer.settings) for t in (v.time, *times))
        at_rest = np.median(others, axis=0) if others else np.inf
        judged = np.abs(v.image - at_rest).max(axis=2) > DIFFERENCE
        pixels.append([image[judged] for image in (drawn, mean, v.image)])
    drawn, mean, truth = map(np.concatenate, zip(*pixels))
    if np.all(np.abs(mean - truth) <= DIFFERENCE):  # one picture is all that there is to see
        return ""
    of_model, of_mean = psnr(drawn, truth), psnr(mean, truth)
    share = 1 - 10 ** ((of_mean - of_model) / 10)
    if share >= MIN_SHARE:
        return ""
    return (
        f"scene {scene.name}: only {max(share, 0):.0%} of what "
        f"{'moves' if len(times) else 'is seen'} is there: in these pixels of "
        f"{'test' if scene.test else 'training'} views the model has {of_model:.2f} dB at "
        f"{v.camera.width}x{v.camera.height}, the mean of the training pictures {of_mean:.2f} dB; "
        "try another seed, more iterations (stage_ends), more views or larger bodies"
    )
