"""Warnings before a training that cannot learn or be repeated, and after one that has not learned.

Each function returns a sentence, or "" if there is nothing to say.
"""

import numpy as np

from .. import effects as fx
from ..arithmetic import other_kernels
from ..messages import number_of
from ..splatting import render
from ..splatting.settings import FAST
from .initial import lattice_nodes

FEW_VIEWS = 24  # half of a packaged scene's views; with far fewer, quality falls
FAR = 10  # times the radius that contains nine tenths of the points
DIFFERENCE = 0.1  # two pixels disagree if a channel differs by more
MUCH = 0.3  # share of what cameras see that may lie outside the box of the first anchors
# The mean of the training pictures has a squared error. This is the least share of it that a model
# must remove. On four scenes of moving bodies, two seeds each, models removed 0.84 to 0.95; with
# half of every body cut off 0 to 0.33, and with half transparent bodies 0.44 to 0.67. On a fifth
# scene, in which hardly anything moved, they removed 0.66 and 0.71.
MIN_SHARE = 0.6
# The same in the worst view: 0.79 to 0.99 on six packaged scenes of which nothing is missing, and
# 0.42 on a scene whose wing was missing in the last views only (0.83 over all its views).
MIN_SHARE_OF_VIEW = 0.5


def warnings_before(trainer):
    """Return the warnings before a training."""
    scene, points = trainer.scene, trainer.points
    if points is None:
        start = small_box(scene, trainer.preset.extent)
    else:
        start = odd_points(scene, trainer.preset.voxel, np.asarray(points))
    sentences = few_views(scene), empty_pictures(scene), start, other_kernels()
    return [sentence for sentence in sentences if sentence]


def nothing_is_drawn(trainer):
    """Return the sentence for a model that draws nothing."""
    return (
        f"scene {trainer.scene.name}: the model draws nothing: every child is masked (min_opacity="
        f"{trainer.preset.min_opacity:g}), below tau_alpha={trainer.preset.tau_alpha:g} or outside "
        "the pictures"
    )


def few_views(scene):
    """Warn if there are too few training views to show how the scene looks from elsewhere."""
    if len(scene.train) >= FEW_VIEWS:
        return ""
    return (
        f"scene {scene.name}: {number_of(len(scene.train), 'training view')}; views that were not "
        f"trained on will be poor with fewer than {FEW_VIEWS}; 48 are enough for packaged scenes"
    )


def empty_pictures(scene):
    """Warn if many pictures show hardly more than one colour."""
    views = [*scene.train, *scene.test]
    empty = sum(np.ptp(view.image.T.copy(), axis=(1, 2)).max() <= DIFFERENCE for view in views)
    if not empty:
        return ""
    return (
        f"scene {scene.name}: {empty} of {number_of(len(views), 'picture')} show hardly more than "
        "one colour; good figures on these mean nothing"
    )


def small_box(scene, extent):
    """Warn if much of what the cameras see lies outside the box of random anchors, or in a corner.

    Every fourth pixel along both sides counts if it differs from the background. What it shows is
    taken to be as far in front of its camera as the point that all cameras look at (`center`), or,
    for cameras that look outwards, as far as the cameras are from their middle. Also warn if all
    cameras are in one place, because depth cannot be measured from there.
    """
    centers = np.array([view.camera.center for view in scene.train])
    spread = np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()
    reach = []
    for view, center in zip(scene.train, centers):
        c, depth = view.camera, max(view.camera.R[2] @ (scene.center - center), spread)
        shown = np.abs(view.image[::4, ::4] - scene.background).max(axis=2) > DIFFERENCE
        v, u = 4 * np.array(np.nonzero(shown))
        ray = np.stack([(u - c.c_x) / c.f_x, (v - c.c_y) / c.f_y, np.ones(len(u))], axis=1)
        reach.append(np.abs(center + depth * ray @ c.R).max(axis=1))
    reach = np.concatenate([[0], *reach])
    enough, outside = np.quantile(reach, 0.9), np.mean(reach > extent)
    if len(centers) > 1 and spread < 1e-3 * np.linalg.norm(scene.center - centers[0]):
        sentence = f"all {len(centers)} training views are from one place, which shows no depth"
    elif outside > MUCH or extent > FAR * enough > 0:
        sentence = (
            f"nine tenths of what the training cameras see seem to lie within {enough:.2g} of the "
            f"origin, {outside:.0%} outside the box of the first anchors; try --set "
            f"extent={enough:.2g} instead of {extent:g}"
        )
    else:
        return ""
    return f"scene {scene.name}: {sentence}; or start from points (--points)"


def odd_points(scene, voxel, points):
    """Warn of starting points that merge, are far from the others, or are seen by no camera."""
    unseen = points  # the first cameras see most of them, so that many points take little time
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
        f"lost by merging with others in a voxel ({voxel:g})": (
            len(points) - len(lattice_nodes(points, voxel))
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
        f"{told or 'all are seen'}; the cameras look at a place {away:.3g} from their middle, and "
        f"they reach {reach.max():.3g}; check the units"
    )


def warning_after(trainer):
    """Warn of a model that draws nothing, or in some view is hardly better than the mean picture.

    The mean picture is that of the training views. If a scene moves, model and mean are compared in
    the pixels that disagree with the model at rest, the median of its own pictures over nine times;
    otherwise in all pixels. The views are test views, which training has not seen, or training
    views if a scene has no others. A single view counts if it has much to lose.
    """
    model, scene = trainer.model(), trainer.scene
    views, mean = scene.test or scene.train, np.mean([v.image for v in scene.train], axis=0)
    views = views[:: 1 + len(views) // 20]  # 10 to 20 of many
    if not any(len(model.gaussians(v.time, v.camera).alpha) for v in views):
        return nothing_is_drawn(trainer)
    # The median of the pictures at nine times shows the model at rest.
    times = np.quantile([v.time for v in scene.train], np.linspace(0, 1, 9))
    if not fx.moves(scene.effects) or not np.ptp(times):
        times = ()
    errors, count, is_seen = [], 0, False
    for v in views:
        drawn, *others = (model.render(v.camera, t, trainer.settings) for t in (v.time, *times))
        at_rest = np.median(others, axis=0) if others else np.inf
        judged = np.abs(v.image - at_rest).max(axis=2) > DIFFERENCE
        truth = v.image[judged].astype(float)
        is_seen |= np.any(np.abs(mean[judged] - truth) > DIFFERENCE)
        count += truth.size
        errors.append(
            [np.sum((np.clip(image[judged], 0, 1) - truth) ** 2) for image in (drawn, mean)]
        )
    if not is_seen:  # the mean picture already shows everything
        return ""
    of_model, of_mean = np.array(errors).T
    share = 1 - of_model.sum() / of_mean.sum()
    shares = 1 - of_model / np.where(of_mean >= of_mean.mean() / 2, of_mean, np.inf)
    worst = shares.argmin()
    if share >= MIN_SHARE and shares[worst] >= MIN_SHARE_OF_VIEW:
        return ""
    model_db, mean_db = -10 * np.log10([of_model.sum() / count, of_mean.sum() / count])
    box = ", another box (extent) or points (--points)" if trainer.points is None else ""
    bodies = ", larger bodies" if len(times) else ""
    return (
        f"scene {scene.name}: only {max(share, 0):.0%} of what "
        f"{'moves' if len(times) else 'is seen'} is drawn, {max(shares[worst], 0):.0%} in the view "
        f"{views[worst].name} (time {views[worst].time:.3g}): in these pixels of "
        f"{'test' if scene.test else 'training'} views the model has {model_db:.2f} dB at "
        f"{v.camera.width}x{v.camera.height}, the mean of the training pictures {mean_db:.2f} dB; "
        f"try another seed, more iterations (stage_ends), more views{bodies}{box}"
    )
