"""The training of one scene: `Trainer.step` is one iteration of the loop.

It takes a random view, its loss and gradients, a check for NaN, a step of Adam, and density
control. `Trainer.learning_rate` and `objective.loss` say what is trained in which stage.
"""

import warnings

import numpy as np

from ..equations import hash_grid
from ..model import Anchors, Model, bounding_box, over_limits, snap, split
from ..scenes.fields import numbers, require_field
from ..splatting.settings import FAST
from . import density, objective
from .initial import design_of, initial_parameters
from .parameters import Adam, Parameters, learning_rate_at
from .presets import MAX_VALUE
from .watch import NotFinite, first_bad, first_not_finite

# The field of the preset that is the learning rate of an array, or of all arrays of a network.
LEARNING_RATES = {
    "x_a": "lr_x",
    "f_a": "lr_f",
    "log_s": "lr_s",
    "log_l": "lr_l",
    "O_a": "lr_O",
    "psi_alpha": "lr_alpha",
    "psi_c": "lr_c",
    "psi_r": "lr_r",
    "psi_s": "lr_psi_s",
    "psi_d": "lr_d",
    "psi_p": "lr_p",
    "psi_q": "lr_q",
    "grid": "lr_grid",
}
# The stage in which an array first takes part; all others take part in all stages.
FIRST_STAGE = {"psi_d": 3, "psi_p": 4, "psi_q": 4, "grid": 4}


def assemble(p, design, mask, box, background):
    """Return the model of Parameters p, with linear attributes, in float64.

    Where `box` is empty, as before stage 4, the box is that of the anchors.
    """
    attributes = split(objective.linear_values(p).astype(float), design)
    p = Parameters(p.arrays, np.float64)
    networks = {name: p.network(name) for name in design.layers()}
    return Model(
        design,
        Anchors(p["x_a"], *attributes, mask.copy()),
        networks,
        grids=p.arrays_of("grid"),
        box=box or bounding_box(p["x_a"]),
        background=np.asarray(background, float),
    )


def with_prefix(named, tag):
    """Return copies of the arrays whose names begin with the tag, by the rest of their names."""
    return {
        name.removeprefix(tag): value.copy()
        for name, value in named.items()
        if name.startswith(tag)
    }


class Trainer:
    """Fits one scene: `step()` does one iteration, `model()` returns the model so far."""

    def __init__(self, scene, preset, seed=0, settings=FAST, points=None):
        self.scene, self.preset, self.settings = scene, preset, settings
        self.seed = numbers(seed, "seed", 0, MAX_VALUE, kind=int)
        self.rng = np.random.default_rng(self.seed)
        self.iteration = 0
        self.order = []  # the views still to be visited, last first
        self.history = []  # rows of training.csv
        self.points = scene.points if points is None else points
        self.design = design_of(preset, scene.effects)
        self.box = ()  # the corners of the bounding box, fixed when stage 4 starts
        self.located = None  # where the positions are in the hash grid, from stage 4 on
        # Anchors start at points [A, 3], or at random without them.
        self.adopt(initial_parameters(preset, self.design, self.rng, self.points))
        self.adam = Adam(self.parameters)
        self.mask = np.ones((len(self.parameters["x_a"]), self.design.k), bool)
        excess = over_limits(self.design, self.count)
        require_field(not excess, "starting points", excess)
        self.statistics = density.Statistics.empty(*self.mask.shape)

    def adopt(self, parameters):
        """Take over parameters and find the networks and grids in them."""
        self.parameters = parameters
        self.networks = {name: parameters.network(name) for name in self.design.layers()}
        self.grids = parameters.arrays_of("grid")

    @property
    def count(self):
        """The number of anchors."""
        return len(self.mask)

    @property
    def stage(self):
        """The stage, 1 to 4, of the next iteration."""
        return self.preset.stage(self.iteration)

    def run(self):
        """Train to the end, without checkpoints, and return the model."""
        while self.iteration < self.preset.iterations:
            self.step()
        return self.model()

    @np.errstate(all="ignore")  # NotFinite names what NumPy would warn of
    def step(self):
        """Do one iteration and return its Losses, its Rendered and its View.

        Raises NotFinite with the first equation, array and index that is NaN or infinite.
        """
        view, p = self.next_view(), self.parameters
        losses, rendered, gradients, mean2d_bar = self.gradients_of(view)
        self.adam.step(p, gradients, lambda name: self.learning_rate(name.split(".")[0]))
        if not np.isfinite(p.vector).all():
            bad = first_bad(p.arrays)
            raise NotFinite(f"iteration {self.iteration}: after Adam's step, parameter {bad}")
        if self.iteration >= self.preset.collect_from:
            self.statistics.collect(rendered, mean2d_bar, view.camera)
        self.iteration += 1
        if self.iteration % self.preset.grow_every == 0:
            self.adjust()
        return losses, rendered, view

    def next_view(self):
        """Return a random view; none is repeated before all others have been visited."""
        if not self.order:
            self.order = self.rng.permutation(len(self.scene.train)).tolist()
        return self.scene.train[self.order.pop()]

    def learning_rate(self, name):
        """Return the learning rate of a name of LEARNING_RATES now; 0 if it does not take part."""
        if self.stage < FIRST_STAGE.get(name, 1) or name == "x_a" and self.stage == 4:
            return 0.0
        return learning_rate_at(
            self.iteration,
            *getattr(self.preset, LEARNING_RATES[name]),
            self.preset.iterations,
            self.preset.decay_from,
        )

    def step_inputs(self):
        """Return the StepInputs of the next iteration."""
        return objective.StepInputs(
            mask=self.mask,
            located=self.located,
            background=self.scene.background,
            stage=self.stage,
            lambda_rate=self.preset.lambda_rate,
            lambda_ssim=self.preset.lambda_ssim,
            settings=self.settings,
        )

    def gradients_of(self, view):
        """Return a view's Losses and Rendered, and the gradients of parameters and of mean2d.

        Raises NotFinite with the first equation, array and index that is NaN or infinite.
        """
        if self.stage == 4 and not self.box:
            self.freeze_positions()
        u = self.rng.random((len(self.mask), sum(self.design.widths)), np.float32) - np.float32(0.5)
        inputs = (
            self.parameters,
            self.design,
            self.networks,
            self.grids,
            self.step_inputs(),
            view,
            u,
        )
        losses, rendered, back = objective.loss(*inputs)
        gradients, mean2d_bar = back()
        # The opacities are checked too: masking would hide a NaN among them from the loss.
        watched = (losses.L_total, gradients.vector, rendered.alpha)
        if not all(np.isfinite(values).all() for values in watched):
            raise NotFinite(f"iteration {self.iteration}: {first_not_finite(inputs)}")
        return losses, rendered, gradients, mean2d_bar

    def freeze_positions(self):
        """Put the positions on the lattice of the box and find them in the hash grid.

        The first call, when stage 4 starts, fixes the box.
        """
        x_a, tables = self.parameters["x_a"], [T for T, _ in self.design.levels()]
        lo, hi = self.box = self.box or bounding_box(x_a)
        x_a[...] = snap(x_a, lo, hi)[1]
        self.located = hash_grid.locate(x_a, lo, hi, self.design.grid, tables)

    def adjust(self):
        """Grow, re-seed, prune and mask as the preset says. Then a new window starts.

        By Scaffold-GS's rule it starts only for children and anchors that have been judged.
        """
        preset, statistics, now = self.preset, self.statistics, self.iteration
        if now >= preset.mask_from:
            self.mask &= ~density.faint_children(statistics, preset)
        dead = density.dead_anchors(statistics, self.mask, preset)
        growing = preset.grow_from < now < preset.grow_until
        p, moments = self.parameters, (self.adam.first, self.adam.second)
        if preset.grow == "reseed" and growing:
            density.reseed(p, *moments, dead, statistics, self.rng)
            self.mask[dead] = True
        elif preset.grow == "reseed" and now >= preset.grow_until:
            self.keep_rows(~dead)  # too late for them to learn anything: they only cost bytes
        elif preset.grow == "scaffold" and growing:
            added = density.grow(p, statistics, preset, self.rng)
            if over_limits(self.design, np.sum(~dead) + len(added["x_a"])):
                warnings.warn("no more anchors grow: a file could not hold them", stacklevel=2)
                added = None
            self.keep_rows(~dead, added)
            log_s = self.parameters["log_s"]
            np.minimum(log_s, density.MAX_LOG_SCALE, out=log_s)
        if preset.grow != "scaffold":
            self.statistics = density.Statistics.empty(*self.mask.shape)
        elif growing or now >= preset.mask_from:
            self.statistics.clear_judged(preset)

    def keep_rows(self, keep, added=None):
        """Drop anchors and append new ones, with their masks, moments and statistics.

        One anchor always stays.
        """
        added = added or {name: self.parameters[name][:0] for name in density.ROWS}
        count = len(added["x_a"])
        if not keep.any() and not count:
            keep[0] = True
        zeros = {name: np.zeros_like(rows) for name, rows in added.items()}
        self.adopt(self.parameters.with_rows(density.ROWS, keep, added))
        self.adam.first, self.adam.second = (
            moments.with_rows(density.ROWS, keep, zeros)
            for moments in (self.adam.first, self.adam.second)
        )
        self.mask = np.concatenate([self.mask[keep], np.ones((count, self.design.k), bool)])
        self.statistics = self.statistics.with_rows(keep, count)
        if self.box:
            self.freeze_positions()

    def model(self):
        """Return the model as it is now, before rounding."""
        return assemble(self.parameters, self.design, self.mask, self.box, self.scene.background)

    def state(self):
        """Return all that another process needs to continue: arrays and JSON values, by name."""
        groups = {
            "p": self.parameters.arrays,
            "m": self.adam.first.arrays,
            "v": self.adam.second.arrays,
            "stat": vars(self.statistics),
        }
        arrays = {f"{tag}/{name}": a for tag, group in groups.items() for name, a in group.items()}
        arrays.update(mask=self.mask, box=np.array(self.box))
        return arrays, {
            "iteration": self.iteration,
            "steps": self.adam.steps,
            "rng": self.rng.bit_generator.state,
            "order": self.order,
            "history": self.history,
        }

    def restore(self, arrays, values):
        """Take over copies of what `state` returned."""
        self.adopt(Parameters(with_prefix(arrays, "p/")))
        self.adam.first, self.adam.second = (
            Parameters(with_prefix(arrays, tag)) for tag in ("m/", "v/")
        )
        self.adam.steps = {**values["steps"]}
        self.statistics = density.Statistics(**with_prefix(arrays, "stat/"))
        self.order, self.iteration = [*values["order"]], values["iteration"]
        self.rng.bit_generator.state, self.history = values["rng"], [*values["history"]]
        self.mask, self.box = arrays["mask"].copy(), tuple(arrays["box"])
        if self.box:
            self.freeze_positions()
