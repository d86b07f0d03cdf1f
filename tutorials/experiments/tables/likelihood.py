"""Does a training end with Eq. (11) as printed, and with a floor under its p?

All else is as in the package, whose own form is the row of `training` with as many iterations.
"""

import copy
from contextlib import suppress

import numpy as np

from p4dgs_ref.codec.file import decode
from p4dgs_ref.equations import likelihood
from p4dgs_ref.lab.accuracy.formulas import as_printed, with_floor
from p4dgs_ref.lab.writer import text_table
from p4dgs_ref.model import context, groups, split
from p4dgs_ref.training import objective, trainer
from p4dgs_ref.training.presets import TINY
from p4dgs_ref.training.watch import NotFinite

from .methods import preset_of, save
from .rows import Task

ITERATIONS = TINY.iterations
FORMS = {"as printed": as_printed, "p at least 1e-30": with_floor(1e-30)}
COLUMNS = {
    "Eq. (11)": "{label}",
    "seed": "{seed}",
    "iterations": "{ended:,}",
    "PSNR dB": "{psnr_db:.2f}",
    "bytes": "{bytes:,}",
}


class Trainer(trainer.Trainer):
    """Trains with another form of Eq. (11), until a gradient is not finite."""

    form = None

    def run(self):
        """Train as far as it goes, and return the model."""
        with suppress(NotFinite):
            super().run()
        return self.model()

    def gradients_of(self, view):
        """The package's, and in stage 4 what the other form changes in them."""
        draw = copy.deepcopy(self.rng)  # of the same noise
        losses, rendered, gradients, mean2d_bar = super().gradients_of(view)
        if self.stage == 4:
            u = draw.random((self.count, sum(self.design.widths)), np.float32) - np.float32(0.5)
            self.change(gradients, u)
            if not np.isfinite(gradients.vector).all():
                raise NotFinite(f"iteration {self.iteration}: Eq. (11)")
        return losses, rendered, gradients, mean2d_bar

    def change(self, gradients, u):
        """Add to gradients the difference of the slopes of both forms, back from the bits."""
        values, design = objective.linear_values(self.parameters), self.design
        ctx, back_context = context(design, self.networks, self.grids, self.located)
        noisy, back_noise = objective.add_noise(values, u, ctx.q, design)
        q = np.repeat(ctx.q, design.widths, axis=1)
        inputs = {"f_noisy": noisy, "mu": ctx.mu, "sigma": ctx.sigma, "q": q}
        inputs = {name: a.astype(float) for name, a in inputs.items()}
        pair = [form(**inputs)[1] for form in (self.form, likelihood.forward)]
        price = np.full(noisy.shape, self.preset.lambda_rate / noisy.size)
        price[:, -3 * design.k :] *= np.repeat(self.mask, 3, axis=1)
        f_bar, sigma_bar, q_bar = (price * (theirs - ours) for theirs, ours in zip(*pair))
        values_bar, steps_bar = back_noise(f_bar)
        starts = np.cumsum((0, *design.widths[:-1]))
        steps_bar += np.add.reduceat(q_bar, starts, axis=1)
        grid_bars, networks_bar = back_context(
            *(a.astype(noisy.dtype) for a in (steps_bar, -f_bar, sigma_bar))
        )
        more = gradients.zeros()
        for name, network_bar in networks_bar.items():
            more.fill(name, network_bar)
        for grid, grid_bar in zip(more.arrays_of("grid"), grid_bars):
            grid[...] = grid_bar
        f, s, l, O = split(values_bar, design)
        _, s_a, l_a, _ = groups(values, design)
        more["f_a"][...], more["O_a"][...] = f, O
        more["log_s"][...], more["log_l"][...] = s * s_a, l * l_a  # the slope of exp
        gradients.vector += more.vector


def make(task, path, source=None):
    """Train with a form as far as it goes, and write the file of what it has reached."""
    trainer = Trainer(task.scene, preset_of(task), task.seed)
    trainer.form = FORMS[task.method]
    return {**save(trainer, path), "ended": trainer.iteration}


def plan(scene, seeds, iterations):
    """The Tasks of both forms and all seeds."""
    command = f"python -m tutorials.experiments.tables likelihood {scene.name}"
    command += f" --seeds {seeds} --iterations {iterations}"
    return [
        Task(scene, form, seed, iterations, make, decode, "p4dgs", command)
        for seed in range(seeds)
        for form in FORMS
    ]


def show(scene, tasks, found):
    """Print how far each training came."""
    print(*text_table(COLUMNS, found), sep="\n")
