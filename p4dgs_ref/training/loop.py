"""The loop that trains every method: one view an iteration, Adam, density control, progress.

`trainer.Trainer` makes it the training of P-4DGS, `baselines.explicit.Trainer` that of the methods
that the paper compares itself with. A subclass supplies

    gradients_of(view)  Losses, what was Rendered, the gradients as Parameters, and
                        those of the splats' mean2d; raises NotFinite
    rate_of(name)       the current learning rate of an array, or of all arrays of a network
    adjust()            density control, at the end of every window of `preset.grow_every`
    primitives          how many anchors or Gaussians there are
    model()             the model so far

and calls `start` with the first parameters. Its preset has the fields `iterations`, `collect_from`
and `grow_every`, and `stage(iteration)`, counted from 1.
"""

import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache

import numpy as np

from ..equations import ssim
from .density import Statistics
from .parameters import Adam
from .watch import NotFinite, first_bad

MAX_MOMENT_BYTES = (
    2**28
)  # bytes of moments for SSIM that are kept: 682 views of 64x64, 4 of 800x800


ROW_EVERY = 20  # most iterations between two rows of training.csv; a short training has more rows
COLUMNS = ("iteration", "stage", "loss", "psnr_db", "bits_per_parameter", "anchors", "gaussians")


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
        self.moments = {}  # by view, as long as they fit into MAX_MOMENT_BYTES bytes

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

        They are four float64 images, computed anew where other views have filled MAX_MOMENT_BYTES.
        """
        if id(view) in self.moments:
            return self.moments[id(view)]
        moments = ssim.moments(view.image)
        if 32 * view.image.size * (len(self.moments) + 1) <= MAX_MOMENT_BYTES:
            self.moments[id(view)] = moments
        return moments

    def step(self):
        """Do one iteration; returns its Losses, what was Rendered, and the View.

        Raises NotFinite with the first equation, array and index that is NaN or infinite.
        """
        view, p = self.next_view(), self.parameters
        losses, rendered, gradients, mean2d_bar = self.gradients_of(view)
        rate_of = cache(self.rate_of)  # all arrays of a network have the same rate
        self.adam.step(p, gradients, lambda name: rate_of(name.split(".")[0]))
        if not np.isfinite(p.vector).all():
            phrase = first_bad(p.arrays, "after Adam's step, parameter ")
            raise NotFinite(f"iteration {self.iteration}: {phrase}")
        if self.iteration >= self.preset.collect_from:
            self.statistics.collect(rendered, mean2d_bar, view.camera.width, view.camera.height)
        self.iteration += 1
        if self.iteration % self.preset.grow_every == 0:
            self.adjust()
        return losses, rendered, view

    def change_rows(self, names, keep, added):
        """Drop rows of the arrays `names` and append `added`, whose Adam moments are zero."""
        zeros = {name: np.zeros_like(rows) for name, rows in added.items()}
        self.adopt(self.parameters.with_rows(names, keep, added))
        self.adam.first, self.adam.second = (
            moments.with_rows(names, keep, zeros) for moments in (self.adam.first, self.adam.second)
        )

    def run(self, report=None):
        """Train to the end and return the model.

        `report(trainer, losses, rendered, view)` is called after each step.
        """
        while self.iteration < self.preset.iterations:
            results = self.step()
            if report:
                report(self, *results)
        return self.model()


def psnr(image, truth):
    """-10 log10 of the mean squared error of images clipped to [0, 1], in dB; inf if equal."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - truth) ** 2))
    return float("inf") if error == 0 else float(-10 * np.log10(error))


class Progress:
    """Called after every step, it extends `trainer.history` and writes a line to `stream`.

    A terminal shows one line that changes. Other streams get about a dozen lines, None gets none.
    """

    def __init__(self, stream=None):
        self.stream, self.live = stream, stream is not None and stream.isatty()
        self.shown, self.steps = time.monotonic(), 0  # the time of the last line, and steps since

    def __call__(self, trainer, losses, rendered, view):
        done, total = trainer.iteration, trainer.preset.iterations
        stage, decibel = trainer.preset.stage(done - 1), psnr(rendered.image, view.image)
        counts = trainer.primitives, len(rendered.index)
        if done % min(ROW_EVERY, max(total // 50, 1)) == 0 or done == total:
            trainer.history.append([done, stage, losses.L_total, decibel, losses.L_rate, *counts])
        self.steps += 1
        seconds = time.monotonic() - self.shown
        due = seconds > 0.2 if self.live else done % max(total // 12, 1) == 0
        if self.stream is None or not (due or done == total):
            return
        ms = 1e3 * seconds / self.steps
        self.shown, self.steps = time.monotonic(), 0
        # The most important numbers come first, because a narrow terminal cuts the line.
        line = (
            f"{done:{len(str(total))}d}/{total}  {1e-3 * ms * (total - done):.0f} s left  "
            f"stage {stage}  loss {losses.L_total:.4f}  PSNR {decibel:.2f} dB  "
            f"{losses.L_rate:.2f} bits/parameter  {counts[0]} {trainer.UNIT}  "
            f"{counts[1]} Gaussians  {ms:.1f} ms/step"
        )
        if self.live:
            line = f"\r{line[: shutil.get_terminal_size().columns - 1]}\x1b[K"
        end = "" if self.live and done < total else "\n"
        with suppress(OSError):  # where the disk is full or the terminal closed, training goes on
            print(line, end=end, file=self.stream, flush=True)
