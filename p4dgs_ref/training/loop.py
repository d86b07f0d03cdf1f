"""The loop that trains every method: one view an iteration, Adam, density control.

`trainer.Trainer` makes it the training of P-4DGS, `baselines.explicit.Trainer` that of the methods
that the paper compares itself with. A subclass supplies

    gradients_of(view)  Losses, what density control has Seen, the gradients as Parameters, and
                        those of the splats' mean2d; raises NotFinite
    rate_of(name)       the current learning rate of an array, or of all arrays of a network
    adjust()            density control, at the end of every window of `preset.grow_every`
    primitives          how many anchors or Gaussians there are
    model()             the model so far

and calls `start` with the first parameters. Its preset has the fields `iterations`, `collect_from`
and `grow_every`, and `stage(iteration)`, counted from 1.
"""

import time
from collections.abc import Callable

import numpy as np

from ..equations import ssim
from .adam import Adam
from .density import Statistics
from .watch import NotFinite, first_bad

MOST_MOMENTS = 2**28  # bytes of moments for SSIM that are kept: 682 views of 64x64, 4 of 800x800


def held_bytes(moments):
    """The bytes that the moments of a view hold; an array that is a view holds its whole base."""
    return sum((a if a.base is None else a.base).nbytes for a in moments)


class Loop:
    """Fits one scene: `step()` does one iteration, `model()` returns the model so far."""

    UNIT = "anchors"  # what a model stores
    gradients_of: Callable
    rate_of: Callable
    adjust: Callable
    model: Callable
    statistics: Statistics

    def __init__(self, scene, preset, seed, settings):
        self.scene, self.preset, self.seed, self.settings = scene, preset, seed, settings
        self.rng = np.random.default_rng(seed)
        self.iteration = 0
        self.order = np.zeros(0, np.int64)  # the views still to be visited, last first
        self.history = []  # rows of training.csv
        self.moments = {}  # by view, as long as they fit into MOST_MOMENTS bytes

    def start(self, parameters):
        """Take over the first parameters, with zero Adam moments."""
        self.adopt(parameters)
        self.adam = Adam(self.parameters)

    def adopt(self, parameters):
        """Take over parameters."""
        self.parameters = parameters

    def next_view(self):
        """A random view; no view comes again before all others have been visited."""
        if not len(self.order):
            self.order = self.rng.permutation(len(self.scene.train))
        index, self.order = self.order[-1], self.order[:-1]
        return self.scene.train[index]

    def moments_of(self, view):
        """The moments of the truth for SSIM, which are the same at every visit.

        They are computed anew where those of other views have filled MOST_MOMENTS.
        """
        if id(view) in self.moments:
            return self.moments[id(view)]
        moments = ssim.moments(view.image)
        if sum(map(held_bytes, [*self.moments.values(), moments])) <= MOST_MOMENTS:
            self.moments[id(view)] = moments
        return moments

    def step(self):
        """Do one iteration; returns its Losses, what was Seen, and the View.

        Raises NotFinite with the first equation, array and index that is NaN or infinite.
        """
        view, p = self.next_view(), self.parameters
        losses, seen, gradients, mean2d_bar = self.gradients_of(view)
        rates = {stem: self.rate_of(stem) for stem in {name.split(".")[0] for name in p.arrays}}
        self.adam.step(p, gradients, lambda name: rates[name.split(".")[0]])
        if not np.isfinite(p.vector).all():
            raise NotFinite(self.iteration, first_bad(p.arrays, "after Adam's step, parameter "))
        if self.iteration >= self.preset.collect_from:
            self.statistics.collect(seen, mean2d_bar, view.camera.width, view.camera.height)
        self.iteration += 1
        if self.iteration % self.preset.grow_every == 0:
            self.adjust()
        return losses, seen, view

    def change_rows(self, names, keep, added):
        """Drop rows of the arrays `names` and append `added`, whose Adam moments are zero."""
        zeros = {name: np.zeros_like(rows) for name, rows in added.items()}
        self.adopt(self.parameters.with_rows(names, keep, added))
        self.adam.first, self.adam.second = (
            moments.with_rows(names, keep, zeros) for moments in (self.adam.first, self.adam.second)
        )

    def run(self, report=None, every_seconds=0.0, save=None):
        """Train to the end and return the model.

        `report(trainer, losses, seen, view, ms)` is called after each step, `save(trainer)` every
        `every_seconds`.
        """
        saved = time.monotonic()
        while self.iteration < self.preset.iterations:
            start = time.perf_counter()
            losses, seen, view = self.step()
            if report:
                report(self, losses, seen, view, 1e3 * (time.perf_counter() - start))
            if save and time.monotonic() - saved > every_seconds:
                save(self)
                saved = time.monotonic()
        return self.model()
