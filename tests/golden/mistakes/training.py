"""Known mistakes between the steps of a training: moments, masks, learning rates."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np

from p4dgs_ref.equations import grid_nodes, hash_grid
from p4dgs_ref.oracle.rooms import ADAM, DENSITY, RATES
from p4dgs_ref.training import density
from p4dgs_ref.training.density import ROWS
from p4dgs_ref.training.parameters import BETA_1, BETA_2, Adam, exponential
from tests.golden import pipeline
from tests.golden.mistakes.kit import surgery
from tests.golden.replay import Replayed, replay


class Inherits(Replayed):
    """New anchors start with the moments of old ones."""

    def keep_rows(self, keep, added=None):
        super().keep_rows(keep, added)
        count = len(added["x_a"])
        for moments in (self.adam.first, self.adam.second):
            for name in ROWS:
                rows = moments[name]
                rows[-count:] = np.resize(rows[:-count], rows[-count:].shape)


class Anew(Replayed):
    """After growing all moments and counts start at zero."""

    def keep_rows(self, keep, added=None):
        super().keep_rows(keep, added)
        self.adam = Adam(self.parameters)


class KeepsTheDead(Replayed):
    """Anchors grow, but none dies."""

    def keep_rows(self, keep, added=None):
        super().keep_rows(np.ones_like(keep), added)


class CountsTheMasked(Replayed):
    """Masked children keep an anchor alive."""

    def keep_rows(self, keep, added=None):
        every = np.ones_like(self.mask)
        dead = density.dead_anchors(self.statistics, every, self.preset)
        super().keep_rows(~dead, added)


class JudgesByBestChild(Replayed):
    """An anchor dies where none of its children is visible enough by itself."""

    def keep_rows(self, keep, added=None):
        best = (self.statistics.opacity * self.mask).max(axis=1, keepdims=True)
        dead = density.dead_anchors(replace(self.statistics, opacity=best), 1, self.preset)
        super().keep_rows(~dead, added)


class LargeScales(Replayed):
    """The scales of anchors have no upper limit."""

    def keep_rows(self, keep, added=None):
        super().keep_rows(keep, added)
        self.large = self.parameters["log_s"].copy()

    def adjust(self):
        self.large = self.parameters["log_s"]
        super().adjust()
        self.parameters["log_s"][...] = self.large


class LinearScales(Replayed):
    """The size of a voxel is stored where its logarithm belongs."""

    def keep_rows(self, keep, added=None):
        sizes = {name: np.exp(added[name]) for name in ("log_s", "log_l")}
        super().keep_rows(keep, {**added, **sizes})


class MovesInStage4(Replayed):
    """Positions go on learning when the grid has located them."""

    def rate_of(self, name):
        if name != "x_a":
            return super().rate_of(name)
        preset = self.preset
        return exponential(self.iteration, *preset.lr_x, preset.iterations, preset.decay_from)


class CountsIterations(Replayed):
    """The bias of the moments is corrected by the iteration, also for arrays that join late."""

    def step(self):
        steps = self.adam.steps
        self.adam.steps = dict.fromkeys(steps, steps["f_a"])
        return super().step()


class NeverMasks(Replayed):
    """Faint children are never masked."""

    def adjust(self):
        before = self.mask.copy()
        super().adjust()
        if self.mask.shape == before.shape:
            self.mask = before


class StockAdam(Adam):
    """torch.optim.Adam: epsilon is added to the root of the corrected second moment."""

    epsilon = 1e-15

    def step(self, parameters, gradients, rate_of):
        before = parameters.vector.copy()
        super().step(parameters, gradients, rate_of)  # moments and counts

        def share(beta, name):
            return 1 - beta ** self.steps[name] or 1

        slow = parameters.per_element(lambda name: rate_of(name) / share(BETA_1, name))
        root = np.sqrt(self.second.vector / parameters.per_element(lambda n: share(BETA_2, n)))
        parameters.vector[...] = before - slow * self.first.vector / (root + self.epsilon)


class WithItsDefault(StockAdam):
    epsilon = 1e-8


def of_trace(id, description, adam):
    def run(given, _):
        with patch.object(pipeline, "Adam", adam):
            return pipeline.trace_vjp(**given)[0], {}

    return surgery("trace", id, description, run)._replace(room=ADAM)


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


def of_training(id, description, replayed, room):
    def run(given, _):
        return replay(**given, trainer=replayed)[0], {}

    return surgery("training", id, description, run)._replace(room=room)


MISTAKES = [
    of_trace(
        "adam-epsilon-after-correction",
        "stock torch.optim.Adam: eps is added after the bias correction of v instead of before",
        StockAdam,
    ),
    of_trace(
        "adam-default-epsilon",
        "torch.optim.Adam with its default eps = 1e-8, which is far above small gradients",
        WithItsDefault,
    ),
    surgery(
        "trace",
        "trace-gradient-through-grid",
        "a gradient flows through the weights of the hash grid into x_a: x_a is not detached there",
        through_the_grid,
    )._replace(room="hash_grid"),
    of_training(
        "training-moments-not-reset",
        "new anchors start with the moments of old ones instead of zeros",
        Inherits,
        DENSITY,
    ),
    of_training(
        "training-optimiser-anew",
        "growing starts all moments and counts of Adam anew",
        Anew,
        DENSITY,
    ),
    of_training(
        "training-dead-stay", "anchors grow, but dead ones are not removed", KeepsTheDead, DENSITY
    ),
    of_training(
        "training-dead-unmasked",
        "the opacities of masked children count for their anchor, which then does not die",
        CountsTheMasked,
        DENSITY,
    ),
    of_training(
        "training-dead-by-best-child",
        "an anchor dies where its best child is too faint, not where all of them together are",
        JudgesByBestChild,
        DENSITY,
    ),
    of_training(
        "training-large-scales",
        "log_s is not clamped to 0.05 where anchors grow and die",
        LargeScales,
        DENSITY,
    ),
    of_training(
        "training-linear-sizes",
        "new anchors store the size of their voxel where its logarithm belongs",
        LinearScales,
        DENSITY,
    ),
    of_training(
        "training-positions-move",
        "positions go on moving in stage 4, away from where the grid has located them",
        MovesInStage4,
        RATES,
    ),
    of_training(
        "training-counts-iterations",
        "Adam corrects its bias by the iteration, also for arrays that join in stage 4",
        CountsIterations,
        ADAM,
    ),
    of_training("training-never-masks", "faint children are never masked", NeverMasks, DENSITY),
]
