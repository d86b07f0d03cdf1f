"""Which effects do the pictures call for? Judged by short trainings in pairs.

An effect reads the time of a view or the position of its camera. These values say something about
the picture only if the effect plays a part. Training begins with the values shuffled among the
views. After half of the iterations it continues twice, once with the shuffled and once with the
true values. Both see the views in the same order, so without the effect neither has an advantage.
They are compared on views held back from both. Occlusion is trained with and without it.

An effect on which the pictures cannot decide is kept: a model with one effect too many is larger, a
model with one too few is wrong.
"""

import json
from dataclasses import dataclass, replace

import numpy as np

from .. import effects as fx
from ..output import write_atomically
from ..scenes.load import DESCRIPTION, read_scene_json
from ..scenes.scene import MODEL_EFFECTS
from ..splatting.camera import Camera
from ..training.objective import psnr
from ..training.presets import TINY
from ..training.trainer import Trainer
from .clock import alternate, step_at
from .processes import in_processes

# The iterations of a training, and the number of pairs, each of which holds back other views.
# Effects of the view are as small as the differences between trainings, so they need two pairs. All
# trainings together have fewer iterations than one of the preset `tiny`.
PAIRS = {
    "translation": (560, 1),
    "view_color": (450, 2),
    "view_geometry": (450, 2),
    "occlusion": (120, 1),
}
HOLD_OUT_EVERY = 6  # one view of so many is held back
MIN_VIEWS = 2 * HOLD_OUT_EVERY  # with fewer, nothing can be held back
MIN_GAIN = 0.2  # dB; effects that gain less are not worth their bytes
OF_VIEW = ("view_color", "view_geometry")


@dataclass(frozen=True)
class MisplacedCamera(Camera):
    """A camera that tells the networks the position of another one."""

    place: np.ndarray | None = None

    @property
    def center(self):
        """The position of the other camera."""
        return self.place


def plan(scene):
    """Return what is trained: (scene, effects of motion, effect, first view held back, steps)."""
    moving = fx.MOTION if len({view.time for view in scene.train}) > 1 else ()
    return [
        (scene, moving, effect, fold, iterations)
        for effect, (iterations, count) in PAIRS.items()
        for fold in range(count)
        if len(scene.train) >= MIN_VIEWS and (moving or effect not in fx.MOTION)
    ]


def steps_of(tasks):
    """Return how many steps the pairs need; a pair shares half, except that of occlusion."""
    return sum((2 if effect == "occlusion" else 1.5) * n for _, _, effect, _, n in tasks)


def seconds_of(scene, jobs=1):
    """Return about how many seconds `suggest` takes, judging by steps with motion."""
    step = step_at(scene, short(PAIRS["translation"][0]), 3)
    ms = alternate({"step": step}, 5)["step"].ms
    return 1e-3 * ms * steps_of(plan(scene)) / jobs


def suggest(scene, progress=lambda line: None, jobs=1):
    """Return the effects that a scene's training views call for, whatever its list of effects.

    Returns [{effect, called_for, verdict, evidence}] for the closed list in its order. The verdict
    is "yes", "no" or "cannot tell"; an effect is called for unless the verdict is "no". The
    evidence is a phrase with a number.
    """
    views, tasks, gains = scene.train, plan(scene), {effect: [] for effect in PAIRS}
    for (_, _, effect, *_), gain in zip(tasks, in_processes(gains_by_view, tasks, jobs)):
        gains[effect].append(gain)
        progress(f"{effect}: {sum(map(len, gains.values()))} of {len(tasks)} pairs")
    answers = {effect: verdict(effect, pairs, len(views)) for effect, pairs in gains.items()}
    if len({view.time for view in views}) == 1:
        answers["translation"] = "no", f"all {len(views)} views have the time {views[0].time:g}"
    motion = answers["translation"]
    if motion[0] == "yes":
        motion = "cannot tell", f"something moves; {len(views)} views do not show how"
    answers |= {
        **dict.fromkeys(("rotation", "scaling"), motion),
        "background": background(views, scene.background),
    }
    return [
        {"effect": name, "called_for": answer != "no", "verdict": answer, "evidence": evidence}
        for name in MODEL_EFFECTS
        for answer, evidence in [answers[name]]
    ]


def gains_by_view(task):
    """Return by how many dB an effect improves each view that was held back: an array."""
    scene, moving, effect, fold, iterations = task
    views, effects = scene.train, {*moving, "occlusion", "background", effect}
    if effect == "occlusion":
        with_it, without_it = (
            scores(scene, views, [views], switched, fold, iterations)[0]
            for switched in (effects, effects - {effect})
        )
    else:
        dealt = shuffle_views(views, effect, fold)
        with_it, without_it = scores(scene, dealt, [views, dealt], effects, fold, iterations)
    return with_it - without_it


def shuffle_views(views, effect, seed):
    """Return the views with the times, or the camera positions, of other views."""
    other = [views[i] for i in np.random.default_rng(seed).permutation(len(views))]
    if effect in fx.MOTION:
        return [replace(view, time=theirs.time) for view, theirs in zip(views, other)]
    return [
        replace(view, camera=MisplacedCamera(**vars(view.camera), place=theirs.camera.center))
        for view, theirs in zip(views, other)
    ]


def short(iterations):
    """Return `tiny` without noise and rate: at first nothing moves and anchors grow."""
    half = iterations // 2
    return replace(
        TINY,
        stage_ends=(half, half, iterations, iterations),
        decay_from=half,
        grow_from=iterations // 12,
        grow_every=max(iterations // 12, 1),
        grow_until=half + 1,
        mask_from=iterations + 1,
    )


def scores(scene, first, seconds, effects, fold, iterations):
    """Return PSNR (dB) of every view that is held back, one array for each of `seconds`.

    The first half of a short training sees the views `first`, the second half those of one of the
    `seconds`.
    """
    held_out = range(fold, len(first), HOLD_OUT_EVERY)

    def trainer_of(views):
        kept = [view for i, view in enumerate(views) if i not in held_out]
        return Trainer(replace(scene, train=kept, effects=tuple(effects)), short(iterations), fold)

    trainer, results = trainer_of(first), []
    while trainer.iteration < iterations // 2:
        trainer.step()
    for views in seconds:
        other = trainer_of(views)
        other.restore(*trainer.state())
        model, judged = other.run(), [views[i] for i in held_out]
        results.append(np.array([psnr(model.render(v.camera, v.time), v.image) for v in judged]))
    return results


def verdict(effect, gains, count):
    """Return (verdict, evidence) from the gains (dB) of views that were held back, in pairs.

    The gains of two pairs differ because their views do, and because trainings do; the larger of
    the two errors counts.
    """
    if not gains:
        return "cannot tell", f"{count} views are too few to hold some back; expected {MIN_VIEWS}"
    pairs, gains = [np.mean(pair) for pair in gains], np.concatenate(gains)
    mean, error = gains.mean(), max(gains.std() / np.sqrt(len(gains)), np.ptp(pairs) / 2)
    # Effects of the view are learned late: a short training shows about half of their gain.
    least = MIN_GAIN / 2 if effect in OF_VIEW else MIN_GAIN
    answer = "no" if mean + 2 * error < least else "cannot tell"
    if mean - 3 * error > MIN_GAIN:
        answer = "yes"
    return answer, f"{mean:+.2f} ± {error:.2f} dB on {len(gains)} views held back"


def background(views, color):
    """Return (verdict, evidence) about a colour behind the scene, from pixels that show it."""
    shares = [
        np.mean(np.abs(view.image - color).max(axis=2) <= 0.02)
        if view.alpha is None
        else np.mean(view.alpha <= 0.5)
        for view in views
    ]
    needed = np.any(shares) and np.any(color)  # black needs no term
    evidence = f"{100 * np.mean(shares):.0f} % of the pixels show it, in the colour {color}"
    return "yes" if needed else "no", evidence


def list_effects(folder, effects):
    """Write a scene's list of effects to its scene.json and return that file.

    Everything else in the file stays, and so do effects of the simulator alone.
    """
    file, description = folder / DESCRIPTION, read_scene_json(folder)
    drawn = [name for name in description.get("effects") or () if name not in MODEL_EFFECTS]
    text = json.dumps({**description, "effects": [*effects, *drawn]}, indent=1) + "\n"
    write_atomically(file, lambda opened: opened.write(text.encode()))
    return file
