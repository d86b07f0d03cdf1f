"""Warnings about a training that cannot learn, before it, and about one that did not, after it.

Each function returns a sentence, or "" where there is nothing to say.
"""

import numpy as np

from .. import effects as fx
from ..splatting.settings import FAST
from .initial import lattice_nodes, starting_points
from .progress import psnr

FEW_VIEWS = 24  # on `bouncing`, 24 views lose 1.2 dB against 48, 16 far more (reference.md, Limits)
FEW_POINTS = 0.1  # the share of starting points that may merge or be unseen without a warning
FAR = 10  # times the distance from the middle of nine tenths of the points
DIFFERENCE = 0.1  # of a channel, from which on two pixels disagree
TIMES = 9  # the model is drawn at so many; the median of these pictures shows it at rest
MAX_VIEWS = 20  # that are drawn so; of more views every second, third, ... is taken
MIN_GAIN = 3.0  # dB above the mean of the training pictures, where something moves


def before(scene, preset, seed, points=None):
    """The warnings before a training."""
    told = few_views(scene), empty_pictures(scene), odd_points(scene, preset, seed, points)
    return [*filter(None, told)]


def few_views(scene):
    """A warning of too few training views to show how the scene looks from elsewhere."""
    if len(scene.train) >= FEW_VIEWS:
        return ""
    return (
        f"scene {scene.name}: {len(scene.train)} training views; views that were not trained "
        f"on will be poor with fewer than {FEW_VIEWS}; 48 are enough for the packaged scenes"
    )


def empty_pictures(scene):
    """A warning of pictures that are blank, or the same as that of a camera elsewhere."""
    views, first, empty = [*scene.train, *scene.test], {}, 0
    for view in views:
        same = first.setdefault(view.image.tobytes(), view)
        is_blank = np.ptp(view.image, axis=(0, 1)).max() <= DIFFERENCE
        empty += is_blank or np.any(view.camera.center != same.camera.center)
    if not empty:
        return ""
    return (
        f"scene {scene.name}: {empty} of {len(views)} pictures show hardly more than one colour, "
        "or the same as that of a camera elsewhere; good figures on these mean nothing"
    )


def odd_points(scene, preset, seed, points):
    """A warning of points to start from that merge or lie far off, or that cameras do not see."""
    points = scene.points if points is None else points
    # The training draws the same points from this seed.
    points = starting_points(points, preset.anchors, preset.extent, np.random.default_rng(seed))
    depth = np.zeros(len(points))  # the largest one at which a picture has the point
    for view in scene.train:
        c = view.camera
        x, y, z = (points @ c.R.T + c.T).T
        u = c.f_x * x + (c.c_x + 0.5) * z  # pixels from the picture's corner, times z
        v = c.f_y * y + (c.c_y + 0.5) * z
        inside = (u >= 0) & (u <= c.width * z) & (v >= 0) & (v <= c.height * z)
        depth = np.maximum(depth, inside * z)
    middle = np.median(points, axis=0)
    reach, away = np.abs(points - middle).max(axis=1), np.abs(scene.center - middle).max()
    far = np.sum(reach > FAR * np.quantile(reach, 0.9))
    counts = {
        f"sharing the voxel of another, so that they merge (voxel {preset.voxel:g})": (
            len(points) - len(lattice_nodes(points, preset))
        ),
        f"outside every training view, or nearer than {FAST.near:g}": np.sum(depth <= FAST.near),
        f"more than {FAR} times as far from their middle as nine tenths of them": far,
    }
    if max(counts.values()) <= FEW_POINTS * len(points) and not far and away <= reach.max():
        return ""
    told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    return (
        f"scene {scene.name}: of {len(points)} starting points, {told or 'all are seen'}; their "
        f"middle is {away:.3g} from what the cameras look at, and they reach {reach.max():.3g} "
        "from it; check units and axes"
    )


def after(trainer):
    """A warning that what moves is hardly better than in one picture shown for all views.

    This picture is the mean of the training views. Both are compared with test views, which
    training has not seen, or with training views where a scene has no others, in all pixels that
    disagree with the median of the model's own pictures over nine times.
    """
    model, scene = trainer.model(), trainer.scene
    views, mean = scene.test or scene.train, np.mean([v.image for v in scene.train], axis=0)
    times = np.quantile([v.time for v in scene.train], np.linspace(0, 1, TIMES))
    pixels = []
    for v in views[:: 1 + len(views) // MAX_VIEWS]:
        drawn, *others = (model.render(v.camera, t, trainer.settings) for t in (v.time, *times))
        moves = np.abs(v.image - np.median(others, axis=0)).max(axis=2) > DIFFERENCE
        pixels.append([image[moves] for image in (drawn, mean, v.image)])
    drawn, mean, truth = map(np.concatenate, zip(*pixels))
    of_mean = psnr(mean, truth) if len(truth) else np.inf  # infinite: nothing moves
    if np.isinf(of_mean) or psnr(drawn, truth) >= of_mean + MIN_GAIN:
        return ""
    return (
        f"scene {scene.name}: "
        f"{'what moves is lost' if fx.moves(scene.effects) else 'the result is useless'}: where "
        f"{'test' if scene.test else 'training'} views differ from the model at rest "
        f"({len(truth) / (len(pixels) * moves.size):.1%} of the pixels), it has "
        f"{psnr(drawn, truth):.2f} dB, the mean of the training pictures {of_mean:.2f} dB; try "
        "another seed, more iterations (stage_ends), more views or larger bodies"
    )
