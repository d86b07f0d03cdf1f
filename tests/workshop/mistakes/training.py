"""Known mistakes between the steps of a training: moments, masks, learning rates."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np

from p4dgs_ref.equations import grid_nodes, hash_grid
from p4dgs_ref.training import density
from p4dgs_ref.training.density import ROWS
from p4dgs_ref.training.parameters import BETA_1, BETA_2, Adam, learning_rate_at
from p4dgs_ref.training.trainer import Trainer
from tests.workshop import pipeline
from tests.workshop.mistakes.kit import surgery
from tests.workshop.replay import Replayed
from tests.workshop.subjects import subjects

# The parts of a training that are to blame where no equation is.
ADAM, DENSITY, RATES = "Adam", "density control", "learning rates"

dead_anchors, grow = density.dead_anchors, density.grow


def inherits(self, keep, added=None):
    """New anchors start with the moments of old ones."""
    Trainer.keep_rows(self, keep, added)
    count = len(added["x_a"])
    for moments in (self.adam.first, self.adam.second):
        for name in ROWS:
            rows = moments[name]
            rows[-count:] = np.resize(rows[:-count], rows[-count:].shape)


def starts_anew(self, keep, added=None):
    """After growing all moments and counts start at zero."""
    Trainer.keep_rows(self, keep, added)
    self.adam = Adam(self.parameters)


def best_child(statistics, mask, preset):
    """An anchor dies where none of its children is visible enough by itself."""
    best = (statistics.opacity * mask).max(axis=1, keepdims=True)
    return dead_anchors(replace(statistics, opacity=best), 1, preset)


def linear_sizes(*given):
    """The size of a voxel is stored where its logarithm belongs."""
    added = grow(*given)
    return added | {name: np.exp(added[name]) for name in ("log_s", "log_l")}


def moves_in_stage_4(self, name):
    """Positions go on learning when the grid has located them."""
    if name != "x_a":
        return Trainer.learning_rate(self, name)
    preset = self.preset
    return learning_rate_at(self.iteration, *preset.lr_x, preset.iterations, preset.decay_from)


def counts_iterations(self):
    """The bias of the moments is corrected by the iteration, also for arrays that join late."""
    steps = self.adam.steps
    self.adam.steps = dict.fromkeys(steps, steps["f_a"])
    return Trainer.step(self)


class StockAdam(Adam):
    """torch.optim.Adam: epsilon is added to the root of the corrected second moment."""

    epsilon = 1e-15

    def step(self, parameters, gradients, learning_rate):
        before = parameters.vector.copy()
        super().step(parameters, gradients, learning_rate)  # moments and counts

        def share(beta, name):
            return 1 - beta ** self.steps[name] or 1

        slow = parameters.per_element(lambda name: learning_rate(name) / share(BETA_1, name))
        root = np.sqrt(self.second.vector / parameters.per_element(lambda n: share(BETA_2, n)))
        parameters.vector[...] = before - slow * self.first.vector / (root + self.epsilon)


class WithItsDefault(StockAdam):
    epsilon = 1e-8


def through_the_grid(given, _):
    """The norm of the gradient of x_a with what flows through the weights of the grid."""
    outputs, read = pipeline.trace_vjp(**given)[0], {}

    def query(located, grids):
        read["signs"] = [np.where(grid >= 0, 1, -1) for grid in grids]
        return kept[0](located, grids)

    def backward(saved, h_bar):
        read["h_bar"] = h_bar
        return kept[1](saved, h_bar)

    kept = hash_grid.query, hash_grid.backward
    with patch.multiple(hash_grid, query=query, backward=backward):
        for norm, (*_, gradients) in zip(outputs["gradient_norm"], pipeline.traced(**given)):
            x_bar = gradients["x_a"] + of_positions(**read, **given)
            norm[given["arrays"].index("x_a")] = np.linalg.norm(x_bar)
    return outputs, {}


def of_positions(signs, h_bar, x_a, lo, hi, resolutions, **_):
    """The gradient of the positions through the multilinear weights of all levels."""
    x_bar = np.zeros_like(x_a)
    h_bar = h_bar.reshape(len(x_a), len(signs), -1)
    for level, (axes, res) in enumerate(resolutions):
        index, _ = grid_nodes.nodes(x_a, lo, hi, axes, res, len(signs[level]))
        axis = ["xyz".index(name) for name in axes]
        position = ((x_a - lo) / (hi - lo))[:, axis] * (res - 1)
        corner = np.indices((2,) * len(axis)).reshape(len(axis), -1).T
        fraction = (position % 1)[:, None]
        factors = np.where(corner, fraction, 1 - fraction)
        for i, column in enumerate(axis):
            slope = np.where(corner[:, i], 1, -1) * np.delete(factors, i, axis=2).prod(axis=2)
            h_slope = np.einsum("ac,acf->af", slope, signs[level][index])
            x_bar[:, column] += (h_bar[:, level] * h_slope).sum(1) * (res - 1) / (hi - lo)[column]
    return x_bar


def of_training(subject, id, description, room, owner, name, wrong):
    """Return a mistake in one function or number of the training, which a room is to blame for."""

    def run(given, _):
        with patch.object(owner, name, wrong):
            return subjects()[subject].vjp(**given)[0], {}

    return surgery(subject, id, description, run, room)


MISTAKES = [
    of_training(
        "trace",
        "adam-epsilon-after-correction",
        "stock torch.optim.Adam: eps is added after the bias correction of v instead of before",
        ADAM,
        pipeline,
        "Adam",
        StockAdam,
    ),
    of_training(
        "trace",
        "adam-default-epsilon",
        "torch.optim.Adam with its default eps = 1e-8, which is far above small gradients",
        ADAM,
        pipeline,
        "Adam",
        WithItsDefault,
    ),
    surgery(
        "trace",
        "trace-gradient-through-grid",
        "a gradient flows through the weights of the hash grid into x_a: x_a is not detached there",
        through_the_grid,
        "hash_grid",
    ),
    of_training(
        "training",
        "training-moments-not-reset",
        "new anchors start with the moments of old ones instead of zeros",
        DENSITY,
        Replayed,
        "keep_rows",
        inherits,
    ),
    of_training(
        "training",
        "training-optimiser-anew",
        "growing starts all moments and counts of Adam anew",
        DENSITY,
        Replayed,
        "keep_rows",
        starts_anew,
    ),
    of_training(
        "training",
        "training-dead-stay",
        "anchors grow, but dead ones are not removed",
        DENSITY,
        density,
        "dead_anchors",
        lambda _, mask, __: np.zeros(len(mask), bool),
    ),
    of_training(
        "training",
        "training-dead-unmasked",
        "the opacities of masked children count for their anchor, which then does not die",
        DENSITY,
        density,
        "dead_anchors",
        lambda sums, _, preset: dead_anchors(sums, 1, preset),
    ),
    of_training(
        "training",
        "training-dead-by-best-child",
        "an anchor dies where its best child is too faint, not where all of them together are",
        DENSITY,
        density,
        "dead_anchors",
        best_child,
    ),
    of_training(
        "training",
        "training-large-scales",
        "log_s is not clamped to 0.05 where anchors grow and die",
        DENSITY,
        density,
        "MAX_LOG_SCALE",
        np.inf,
    ),
    of_training(
        "training",
        "training-linear-sizes",
        "new anchors store the size of their voxel where its logarithm belongs",
        DENSITY,
        density,
        "grow",
        linear_sizes,
    ),
    of_training(
        "training",
        "training-positions-move",
        "positions go on moving in stage 4, away from where the grid has located them",
        RATES,
        Replayed,
        "learning_rate",
        moves_in_stage_4,
    ),
    of_training(
        "training",
        "training-counts-iterations",
        "Adam corrects its bias by the iteration, also for arrays that join in stage 4",
        ADAM,
        Replayed,
        "step",
        counts_iterations,
    ),
    of_training(
        "training",
        "training-never-masks",
        "faint children are never masked",
        DENSITY,
        density,
        "faint_children",
        lambda *_: np.False_,
    ),
]
