"""Known mistakes between the steps of a training: moments, masks, learning rates."""

import numpy as np

from p4dgs_ref.training.density import ROWS
from p4dgs_ref.training.parameters import Adam, exponential
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


def of_training(id, description, trainer):
    def run(given, _):
        return replay(**given, trainer=trainer)[0], {}

    return surgery("training", id, description, run)


MISTAKES = [
    of_training(
        "training-moments-not-reset",
        "new anchors start with the moments of old ones instead of zeros",
        Inherits,
    ),
    of_training(
        "training-optimiser-anew",
        "growing starts all moments and counts of Adam anew",
        Anew,
    ),
    of_training("training-dead-stay", "anchors grow, but dead ones are not removed", KeepsTheDead),
    of_training(
        "training-linear-sizes",
        "new anchors store the size of their voxel where its logarithm belongs",
        LinearScales,
    ),
    of_training(
        "training-positions-move",
        "positions go on moving in stage 4, away from where the grid has located them",
        MovesInStage4,
    ),
    of_training(
        "training-counts-iterations",
        "Adam corrects its bias by the iteration, also for arrays that join in stage 4",
        CountsIterations,
    ),
    of_training("training-never-masks", "faint children are never masked", NeverMasks),
]
