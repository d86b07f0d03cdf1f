"""Vectors of level L4 for a port of the training: steps to replay, compared array by array.

A case is a state, the views and noise of some steps, and the state after them. `replay` is the
package's own Trainer, so that a change of the training shows here. A network is one vector, as in a
file: layer by layer, W row by row, then b. The levels of the grid follow each other in one vector.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from p4dgs_ref.model import bounding_box
from p4dgs_ref.oracle import published
from p4dgs_ref.oracle.compare import cast
from p4dgs_ref.scenes.scene import View
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.density import Statistics
from p4dgs_ref.training.parameters import Adam, Parameters
from p4dgs_ref.training.presets import FIELDS, SMOKE
from p4dgs_ref.training.trainer import LEARNING_RATES, Trainer
from tests.workshop.cases import Case
from tests.workshop.flat import camera_of
from tests.workshop.pipeline import (
    ARRAYS,
    LOSSES,
    by_step,
    joined,
)
from tests.workshop.subjects import as_published, no_pullback

ROLES = {"": "parameters", "m_": "first", "v_": "second"}
SUMS = ("visits", "opacity", "gradient", "seen")
GIVEN = ("W", "T", "focal", "center", "size", "times", "truth", "background")  # the views


class GivenNumbers:
    """Stands for the Generator of a Trainer: noise of the steps, then the draws of growing."""

    def __init__(self, noise, draws):
        self.noise, self.draws = list(noise), list(draws)

    def random(self, shape, *_):
        """Return the next numbers in [0, 1)."""
        return self.noise.pop(0) + 0.5 if isinstance(shape, tuple) else self.draws.pop(0)


class Replayed(Trainer):
    """A Trainer that computes with the float32 corners of the box in its own precision."""

    def freeze_positions(self):
        corners = self.box or bounding_box(self.parameters["x_a"])
        self.box = tuple(corner.astype(self.parameters.vector.dtype) for corner in corners)
        super().freeze_positions()


def parted(arrays, design):
    """Undo `joined`: the Parameters of {array: values}."""
    parts_by_name = {}
    for stem, values in arrays.items():
        if stem == "grid":
            shapes = {f"grid.{i}": shape for i, shape in enumerate(design.levels())}
        elif stem in design.layers():
            shapes = {}
            for i, (rows, columns) in enumerate(design.layers()[stem]):
                shapes |= {f"{stem}.W{i}": (rows, columns), f"{stem}.b{i}": (columns,)}
        else:
            parts_by_name[stem] = values
            continue
        ends = np.cumsum([np.prod(shape) for shape in shapes.values()])
        parts = np.split(values, ends[:-1])
        parts_by_name |= {name: a.reshape(shape) for (name, shape), a in zip(shapes.items(), parts)}
    return Parameters(parts_by_name, arrays["x_a"].dtype)


def views_of(W, T, focal, center, size, times, truth):
    """Return the training views."""
    cameras = [camera_of(*pose, size) for pose in zip(W, T, focal, center)]
    named = zip(truth, cameras, np.asarray(times).tolist())
    return tuple(View("", image, None, camera, time) for image, camera, time in named)


def trainer_of(state, views, background, iteration, effects):
    """Return a Trainer in a given state: arrays, moments, steps, mask, sums, box, and settings."""
    preset = replace(SMOKE, **{n: v for n, v in state.items() if n in FIELDS})
    scene = SimpleNamespace(train=views, effects=effects, background=background, points=None)
    trainer = Replayed(scene, preset, settings=EXACT)
    p, m, v = (
        parted({name: state[tag + name] for name in ARRAYS}, trainer.design) for tag in ROLES
    )
    trainer.adopt(p)
    trainer.adam = Adam(p)
    trainer.adam.first, trainer.adam.second = m, v
    steps = dict(zip(ARRAYS, state["steps"].tolist()))
    trainer.adam.steps = {name: steps[name.split(".")[0]] for name in p.arrays}
    trainer.mask = state["mask"].copy()
    trainer.statistics = Statistics(*(np.array(state[name], float) for name in SUMS))
    trainer.iteration = iteration
    if len(state["box"]):
        trainer.box = tuple(state["box"])
        trainer.freeze_positions()
    return trainer


def state_of(trainer):
    """Return the state of a Trainer by the names of the vectors."""
    adam, dtype = trainer.adam, trainer.parameters.vector.dtype
    held = {"": trainer.parameters, "m_": adam.first, "v_": adam.second}
    state = {tag + name: joined(p, name) for tag, p in held.items() for name in ARRAYS}
    counts = {name.split(".")[0]: n for name, n in adam.steps.items()}
    state["steps"] = np.array([counts[name] for name in ARRAYS])
    state["mask"] = trainer.mask.copy()
    for name in SUMS:
        state[name] = getattr(trainer.statistics, name).astype(dtype)
    state["box"] = np.array(trainer.box or np.zeros((0, 3)), dtype).reshape(-1, 3)
    return state


def steps(u, views, iteration, effects, draws=(), **inputs):
    """Yield the losses and learning rates of every step from a state, and the state after it.

    Growing, masking and the change of the stage happen within the steps where the settings say so.
    """
    scene = {name: inputs.pop(name) for name in GIVEN}
    background = scene.pop("background")
    trainer = trainer_of(inputs, views_of(**scene), background, iteration, effects)
    trainer.rng = GivenNumbers(u, draws)
    trainer.order = [*views[::-1]]
    for _ in views:
        rates = [trainer.learning_rate(name) for name in ARRAYS]
        losses = trainer.step()[0]
        yield losses, rates, state_of(trainer)


def replay(**inputs):
    """Steps of training from a state: the state after them, and the losses before each of them.

    `rates` are the learning rates of every step.
    """
    rows, rates, states = zip(*steps(**inputs))
    dtype = inputs["x_a"].dtype
    losses = {name: np.array([getattr(row, name) for row in rows], dtype) for name in LOSSES}
    return {**losses, "rates": np.array(rates, dtype), **states[-1]}, no_pullback


def replay_steps(**inputs):
    """The same steps: the loss of each of them and the state after it, the moments first."""
    states = []
    for losses, _, state in steps(**inputs):
        loss = inputs["x_a"].dtype.type(losses.L_total)
        moments_first = sorted(state, key=lambda name: name[:2] not in ROLES)
        states.append({"L_total": loss, **{name: state[name] for name in moments_first}})
    return by_step(states), no_pullback


def added():
    """Yield the cases that joined after version 1.0, in which no two settings are equal.

    They go on from the state of `growing`, with fewer views of some children; child n is child
    n % 2 of anchor n // 2. `apart` does four steps, of which the last two are counted; then anchors
    grow. A case ends there: noise for one number of anchors does not fit another. Children 3, 6, 7
    and 12 are masked, so that no step adds to the sums that they are given here.

    Level 1, voxels of 0.8: 5 and 6 share a free one, 7 and 8 another one, and of two features each
    is larger in some numbers. 3 has been seen too rarely. 7 is above the threshold per view in
    which it was seen, not per visit of its anchor.
    Level 2, voxels of 0.2: 12 lies in that of the anchor that 7 and 8 have just made, and the draw
    of 10 is between 1/4 and 1/2.
    Level 3, voxels of 0.05: the draw of 9 is between 1/8 and 1/4.

    In the fourth step child 13 is behind the camera. Five anchors have two visits, which is not
    more than the window; one scale is above its limit. `from` and `until` do two steps each and end
    with an adjustment on `grow_from` and on `grow_until`, so that nothing grows.
    """
    start = {case.name: case for case in published.cases("training")}["growing"]
    state = cast(start.inputs(), np.float64)
    state["O_a"][6] = (-1.25, -0.75, -2), (2.25, -1.125, 2.5)
    state["log_s"][5, 1] = 0.25
    state["T"][4, 2] -= 1.75
    state["mask"].flat[[3, 6, 7, 12]] = False
    state["visits"][[3, 4]] = 3
    often = [5, 6, 7, 8, 9, 10, 12]
    state["seen"].flat[often] = 2
    state["gradient"].flat[[3, *often]] = np.array([32, 16, 16, 3, 16, 32, 16, 16]) / 512
    draws = np.full((3, 14), 0.0625)
    draws[0, [3, 5, 6, 7, 8]] = 0.75
    draws[1, [10, 12]] = 0.375, 0.75
    draws[2, 9] = 0.1875
    settings = {
        name: ((3 + i) * 2.0**-10, (2 + i) * 2.0**-12)
        for i, name in enumerate(LEARNING_RATES.values())
    }
    settings |= dict(Q_f=0.25, Q_s=0.0078125, Q_l=0.015625, Q_O=0.125, lambda_rate=0.03125)
    settings |= dict(grow_every=8, success=0.25, grow_from=3, grow_until=24, mask_from=99)
    settings |= dict(collect_from=6, stage_ends=(0, 0, 9, 30), decay_from=5, draws=[*draws])
    inputs = {**cast(cast(state, np.float32), np.float64), **settings}
    noise = [*np.random.default_rng(1).integers(-64, 64, (8, 7, 16)) / 128]
    for name, iteration, views, u, changed in (
        ("apart", 4, [2, 3, 1, 4], noise[:4], {}),
        ("from", 6, [1, 4], noise[4:6], {"grow_from": 8}),
        ("until", 22, [0, 4], noise[6:], {}),
    ):
        steps_of = dict(iteration=iteration, views=np.array(views), u=u)
        yield Case(name, {**inputs, **steps_of, **changed}, ("replay", "behind", "clamped"))


# On a lattice whose corners are float32 numbers: a small coordinate has no more digits.
EVEN = ("out.x_a", *(f"out.x_a.{i}" for i in range(6)))
SUBJECTS = (
    as_published("training_steps", replay_steps, single=True, even=EVEN),
    as_published("training", replay, added, single=True, even=EVEN),
    as_published("training_whole", replay, single=True, even=EVEN),
)
