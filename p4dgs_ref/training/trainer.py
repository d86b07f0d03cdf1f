"""The four stages of training: one view an iteration, Adam, growing and pruning, a state that can be saved."""

import time

import numpy as np

from ..equations import hash_grid, ssim
from ..model import Anchors, Model, bounding_box, snap, split
from ..splatting.settings import FAST
from . import density, objective
from .adam import Adam, exponential
from .finite import NotFinite, find_first
from .initial import design_of, initial_parameters
from .parameters import Parameters

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
CONTEXT = ("psi_p", "psi_q", "grid")  # take part from stage 4 on; psi_d from stage 3 on


def assemble(p, design, mask, box, background):
    """The Model of some parameters: linear attributes, everything in float64; without a box, the exact one."""
    f, s, l, O = split(objective.linear_values(p).astype(float), design)
    x_a = p["x_a"].astype(float)
    networks = {
        name: tuple([a.astype(float) for a in arrays] for arrays in p.network(name))
        for name in design.layers()
    }
    grids = [grid.astype(float) for grid in p.listed("grid")]
    return Model(
        design,
        Anchors(x_a, f, s, l, O, mask.copy()),
        networks,
        grids,
        box or bounding_box(x_a),
        np.asarray(background, float),
    )


class Trainer:
    """Fits one scene; `step()` is one iteration, `model()` what has been learnt so far."""

    def __init__(self, scene, preset, seed=0, settings=FAST, points=None):
        self.scene, self.preset, self.seed, self.settings = scene, preset, seed, settings
        self.rng = np.random.default_rng(seed)
        self.design = design_of(preset, scene.effects)
        self.iteration, self.located, self.box = 0, None, None
        self.order, self.history, self.moments = np.zeros(0, np.int64), [], {}
        self.adopt(initial_parameters(preset, self.design, self.rng, points))
        self.adam = Adam(self.parameters)
        A = len(self.parameters["x_a"])
        self.mask, self.statistics = (
            np.ones((A, self.design.k), bool),
            density.Statistics(A, self.design.k),
        )

    def adopt(self, parameters):
        """Take parameters over and find the networks and grids in them."""
        self.parameters = parameters
        self.networks = {name: parameters.network(name) for name in self.design.layers()}
        self.grids = parameters.listed("grid")

    @property
    def stage(self):
        return self.preset.stage(self.iteration)

    def rate_of(self, name):
        """The learning rate of an array now; 0 where the stage does not use it."""
        stem = name.split(".")[0]
        if (
            stem in CONTEXT
            and self.stage < 4
            or stem == "psi_d"
            and self.stage < 3
            or stem == "x_a"
            and self.stage == 4
        ):
            return 0.0
        first, last = getattr(self.preset, LEARNING_RATES[stem])
        return exponential(
            self.iteration, first, last, self.preset.iterations, self.preset.decay_from
        )

    def next_view(self):
        """Views in random order without replacement, then again."""
        if not len(self.order):
            self.order = self.rng.permutation(len(self.scene.train))
        index, self.order = self.order[-1], self.order[:-1]
        return self.scene.train[index]

    def fixed(self):
        preset, stage = self.preset, self.stage
        return objective.Fixed(
            self.mask,
            self.located,
            self.scene.background,
            stage >= 2,
            stage >= 3,
            preset.lambda_rate,
            preset.lambda_ssim,
            preset.lambda_volume,
            self.settings,
        )

    def step(self):
        """One iteration; returns its Losses, what was Seen, and the View.

        Raises     NotFinite naming the first equation and array in which a number stopped being one
        """
        if self.stage == 4 and self.located is None:
            self.freeze_positions()
        view, p = self.next_view(), self.parameters
        u = self.rng.random((len(self.mask), sum(self.design.widths)), np.float32) - np.float32(0.5)
        if id(view) not in self.moments:  # SSIM's averages of the truth are the same in every visit
            self.moments[id(view)] = ssim.moments(view.image)
        inputs = (
            p,
            self.design,
            self.networks,
            self.grids,
            self.fixed(),
            view,
            u,
            self.moments[id(view)],
        )
        losses, seen, res = objective.forward(*inputs)
        gradients, mean2d_bar = objective.backward(res)
        finite = np.isfinite(losses.L_total) and np.isfinite(gradients.vector).all()
        if not (
            finite and np.isfinite(seen.alpha).all()
        ):  # the mask would hide a NaN opacity from the loss
            raise NotFinite(self.iteration, find_first(*inputs))
        self.adam.step(p, gradients, self.rate_of)
        if self.iteration >= self.preset.collect_from:
            self.statistics.collect(seen, mean2d_bar, view.camera.width, view.camera.height)
        self.iteration += 1
        if self.iteration % self.preset.grow_every == 0:
            self.adjust()
        return losses, seen, view

    def freeze_positions(self):
        """Stage 4 starts: fix the box, put positions on its 16-bit lattice, locate them in the grid."""
        self.box = bounding_box(self.parameters["x_a"])
        self.locate()

    def locate(self):
        x_a = self.parameters["x_a"]
        x_a[...] = snap(x_a, *self.box)[1]
        self.located = hash_grid.locate(
            x_a, *self.box, self.design.grid, [T for T, _ in self.design.levels()]
        )

    def adjust(self):
        """Grow, re-seed, prune and mask as the preset says, then start a new window."""
        preset, statistics, now = self.preset, self.statistics, self.iteration
        if now >= preset.mask_from:
            self.mask &= ~density.faint_children(statistics, preset)
        dead, growing = (
            density.dead_anchors(statistics, self.mask, preset),
            preset.grow_from < now <= preset.grow_until,
        )
        if preset.grow == "reseed" and growing:
            density.reseed(
                self.parameters, self.adam.first, self.adam.second, dead, statistics, self.rng
            )
            self.mask[dead] = True
        elif preset.grow == "reseed" and now > preset.grow_until:
            self.keep_rows(~dead)  # too late to learn something new: they only cost
        elif preset.grow == "scaffold" and growing:
            self.keep_rows(~dead, density.grow(self.parameters, statistics, preset, self.rng))
            self.parameters["log_s"][...] = np.minimum(
                self.parameters["log_s"], density.LARGEST_LOG_SCALE
            )
        self.statistics.clear()

    def keep_rows(self, keep, added=None):
        """Drop anchors, append new ones, and carry masks, moments and statistics along; never drops the last anchor."""
        added = density.empty_rows(self.parameters) if added is None else added
        if not keep.any() and not len(added["x_a"]):
            keep = np.arange(len(keep)) == 0
        fresh = {name: np.zeros_like(rows) for name, rows in added.items()}
        self.adopt(self.parameters.with_rows(density.ROWS, keep, added))
        self.adam.first = self.adam.first.with_rows(density.ROWS, keep, fresh)
        self.adam.second = self.adam.second.with_rows(density.ROWS, keep, fresh)
        self.mask = np.concatenate(
            [self.mask[keep], np.ones((len(added["x_a"]), self.design.k), bool)]
        )
        self.statistics = self.statistics.with_rows(keep, len(added["x_a"]))
        if self.located is not None:
            self.locate()

    def run(self, report=None, every_seconds=None, save=None):
        """Train to the end; `report(trainer, losses, seen, view, ms)` after each step, `save(trainer)` now and then."""
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

    def model(self):
        """The model as it stands, before rounding."""
        return assemble(self.parameters, self.design, self.mask, self.box, self.scene.background)

    def state(self):
        """Everything that a later process needs to go on as if nothing had happened: {name: array or JSON value}."""
        groups = {"p": self.parameters, "m": self.adam.first, "v": self.adam.second}
        arrays = {
            f"{tag}/{name}": a for tag, group in groups.items() for name, a in group.arrays.items()
        }
        arrays.update(
            {f"stat/{name}": getattr(self.statistics, name) for name in density.Statistics.NAMES}
        )
        arrays.update({"mask": self.mask, "order": self.order})
        if self.box is not None:
            arrays["box"] = np.stack(self.box)
        return arrays, {
            "iteration": self.iteration,
            "steps": self.adam.steps,
            "rng": self.rng.bit_generator.state,
            "history": self.history,
        }

    def restore(self, arrays, values):
        """The inverse of `state`."""

        def group(tag):
            return Parameters(
                {name[2:]: a for name, a in arrays.items() if name.startswith(tag + "/")}
            )

        self.adopt(group("p"))
        self.adam.first, self.adam.second, self.adam.steps = (
            group("m"),
            group("v"),
            dict(values["steps"]),
        )
        self.mask, self.order, self.iteration = arrays["mask"], arrays["order"], values["iteration"]
        self.statistics = density.Statistics(len(self.mask), self.design.k)
        for name in density.Statistics.NAMES:
            setattr(self.statistics, name, arrays[f"stat/{name}"])
        self.rng.bit_generator.state, self.history = values["rng"], values["history"]
        if "box" in arrays:
            self.box = tuple(arrays["box"])
            self.locate()
