"""Vectors of level L4 for a port of the training: steps to replay, compared array by array.

A case is a state, the views and noise of some steps, and the state after them. `replay` is the
package's own Trainer, so that a change of the training shows here. A network is one vector, as in a
file: layer by layer, W row by row, then b. The levels of the grid follow each other in one vector.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from p4dgs_ref.model import bounding_box
from p4dgs_ref.scenes.scene import View
from p4dgs_ref.splatting.settings import EXACT
from p4dgs_ref.training.density import Statistics
from p4dgs_ref.training.parameters import Adam, Parameters
from p4dgs_ref.training.presets import FIELDS, SMOKE
from p4dgs_ref.training.trainer import Trainer
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


# On a lattice whose corners are float32 numbers: a small coordinate has no more digits.
EVEN = ("out.x_a", *(f"out.x_a.{i}" for i in range(6)))
SUBJECTS = (
    as_published("training_steps", replay_steps, single=True, even=EVEN),
    as_published("training", replay, single=True, even=EVEN),
    as_published("training_whole", replay, single=True, even=EVEN),
)
