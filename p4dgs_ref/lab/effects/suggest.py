"""Which effects do the pictures call for? Judged by short trainings in pairs.

What an effect looks at, the time of a view or the place of its camera, tells something about the
picture only where the effect plays a part. Both trainings of a pair are first given these values
dealt out to the views at random, and are the same until half of their iterations. Then one of them
is given the true values. They see the views in the same order, so without the effect neither has an
advantage. They are compared on views that neither has seen. Occlusion is trained with and without
it.

An effect that the pictures cannot decide is kept: a model with an effect too many is larger, a
model with an effect too few is wrong.
"""

from dataclasses import dataclass, replace

import numpy as np

from ... import effects as fx
from ...report.evaluate import decibel, squared_error
from ...report.jobs import in_processes
from ...scenes.scene import MODEL_EFFECTS
from ...splatting.camera import Camera
from ...training.presets import TINY
from ...training.trainer import Trainer

ITERATIONS = 600
FOLDS = 2  # pairs for each effect; each keeps another part of the views back
BACK = 6  # one view of so many is kept back
FEWEST = 2 * BACK  # views; with fewer nothing can be kept back
WORTH = 0.2  # dB; effects that gain less are not worth their bytes
VIEW = ("view_color", "view_geometry")


@dataclass(frozen=True)
class SeenFrom(Camera):
    """A camera whose place, as the networks are told it, is not its own."""

    told: np.ndarray = None

    @property
    def center(self):
        """The place that the networks are told."""
        return self.told


def suggest(scene, iterations=ITERATIONS, progress=lambda line: None, jobs=1):
    """The effects that a scene's training views call for; its list of effects is not read.

    Returns [{effect, called_for, verdict, evidence}] for the closed list in its order. The verdict
    is "yes", "no" or "cannot tell"; an effect is called for unless the verdict is "no". The
    evidence is one sentence with a number.
    """
    views = scene.train
    times = {view.time for view in views}
    moving = fx.MOTION if len(times) > 1 else ()
    asked = ("translation", *VIEW, "occlusion") if len(times) > 1 else (*VIEW, "occlusion")
    gains = {}
    if len(views) >= FEWEST:
        folds = range(FOLDS)
        tasks = [(scene, moving, effect, fold, iterations) for effect in asked for fold in folds]
        for (_, _, effect, fold, _), gain in zip(tasks, in_processes(paired, tasks, jobs)):
            progress(f"{effect}: pair {fold + 1} of {FOLDS}")
            gains.setdefault(effect, []).append(gain)
    said = {effect: verdict(effect, gains.get(effect), len(views)) for effect in MODEL_EFFECTS}
    if not moving:
        still = f"all {len(views)} views have the time {min(times):g}, so nothing can move"
        said.update(dict.fromkeys(fx.MOTION, ("no", still)))
    elif said["translation"][0] == "yes":
        apart = (
            f"something moves, and {len(views)} views, each with its own time, do not show whether "
            "parts are carried along or turn or grow"
        )
        said.update(dict.fromkeys(("rotation", "scaling"), ("cannot tell", apart)))
    else:
        said.update(dict.fromkeys(fx.MOTION, said["translation"]))
    said["background"] = background(views, scene.background)
    return [
        {
            "effect": effect,
            "called_for": said[effect][0] != "no",
            "verdict": said[effect][0],
            "evidence": said[effect][1],
        }
        for effect in MODEL_EFFECTS
    ]


def paired(task):
    """By how many dB an effect improves each view that was kept back: an array."""
    scene, moving, effect, fold, iterations = task
    effects = {*moving, "occlusion", "background", effect}
    if effect == "occlusion":
        builds = (scene.train, scene.train, effects), (scene.train, scene.train, effects - {effect})
    else:
        dealt = shuffled(scene.train, effect, fold)
        builds = (dealt, scene.train, effects), (dealt, dealt, effects)
    with_it, without_it = (scores(scene, *build, fold, iterations) for build in builds)
    return with_it - without_it


def shuffled(views, effect, seed):
    """The views with the times, or the places of the cameras, of other views."""
    other = [views[i] for i in np.random.default_rng(seed).permutation(len(views))]
    if effect in fx.MOTION:
        return [replace(view, time=theirs.time) for view, theirs in zip(views, other)]
    return [
        replace(view, camera=SeenFrom(**vars(view.camera), told=theirs.camera.center))
        for view, theirs in zip(views, other)
    ]


def scores(scene, first, views, effects, fold, iterations):
    """PSNR (dB) of every view that is kept back, after a short training without noise and rate.

    Its first half is given the views `first`, its second half `views`.
    """
    back, half = range(fold, len(views), BACK), iterations // 2
    first, second = (
        [view for i, view in enumerate(half_views) if i not in back]
        for half_views in (first, views)
    )
    preset = TINY._replace(
        stage_ends=(half, half, iterations, iterations),
        decay_from=half,
        grow_from=iterations // 12,
        grow_every=max(iterations // 12, 1),
        grow_until=half + 1,
        mask_from=iterations + 1,
    )
    trainer = Trainer(replace(scene, train=first, effects=tuple(effects)), preset, fold)
    with np.errstate(all="ignore"):
        while trainer.iteration < half:
            trainer.step()
        trainer.scene = replace(trainer.scene, train=second)
        model = trainer.run()
    drawn = [(model.render(views[i].camera, views[i].time), views[i].image) for i in back]
    return np.array([decibel(squared_error(*pair)) for pair in drawn])


def verdict(effect, gains, count):
    """(verdict, evidence) from the gains (dB) of the views that were kept back, or None.

    The gains of two pairs differ because their views do, and because trainings do; the larger of
    the two errors counts.
    """
    if gains is None:
        return "cannot tell", f"{count} views are too few to keep some back; expected {FEWEST}"
    pairs, gains = [np.mean(pair) for pair in gains], np.concatenate(gains)
    mean, error = gains.mean(), max(gains.std() / np.sqrt(len(gains)), np.ptp(pairs) / 2)
    without = "without hiding what is behind"
    if effect != "occlusion":
        without = f"with the {'times' if effect in fx.MOTION else 'cameras'} of other views"
    evidence = (
        f"{mean:+.2f} ± {error:.2f} dB on {len(gains)} views kept back, against training {without}"
    )
    if mean - 3 * error > WORTH:
        return "yes", evidence
    if mean + 2 * error < WORTH:
        return "no", evidence
    return "cannot tell", evidence


def background(views, color):
    """(verdict, evidence) about a colour behind the scene, from the pixels that show it."""
    shares = [
        np.mean(np.abs(view.image - color).max(axis=2) <= 0.02)
        if view.alpha is None
        else np.mean(view.alpha <= 0.5)
        for view in views
    ]
    shown = f"{100 * np.mean(shares):.0f} % of the pixels show"
    if not np.any(shares):
        return "no", f"{shown} the background"
    if not np.any(color):
        return "no", f"{shown} the background, and it is black, which needs no term"
    return "yes", f"{shown} a background that is not black"
