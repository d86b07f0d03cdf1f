"""The four stages of training: what is trained when, density control, a state to save."""

import numpy as np

from ..equations import hash_grid
from ..model import Anchors, Model, bounding_box, snap, split
from ..splatting.settings import FAST
from . import coded_networks, density, objective
from .body import LEAST_SHARE, body, unlike
from .initial import design_of, initial_parameters
from .loop import Loop
from .parameters import Parameters, exponential
from .watch import NotFinite, find_first

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
    "psi_t": "lr_d",
    "psi_p": "lr_p",
    "psi_q": "lr_q",
    "grid": "lr_grid",
    "log_step": "lr_step",
}
# The stage in which an array first takes part; all others take part in all stages.
FIRST_STAGE = {"psi_d": 3, "psi_t": 3, "psi_p": 4, "psi_q": 4, "grid": 4, "log_step": 4}


def assemble(p, design, mask, box, background):
    """The model of some parameters, linear and in float64; without a box, the exact one."""
    f, s, l, O = split(objective.linear_values(p).astype(float), design)
    exact = Parameters(p.arrays, np.float64)
    networks = {name: exact.network(name) for name in design.layers()}
    return Model(
        design,
        Anchors(exact["x_a"], f, s, l, O, mask.copy()),
        networks,
        grids=exact.listed("grid"),
        box=box or bounding_box(exact["x_a"]),
        background=np.asarray(background, float),
        steps=coded_networks.learned_steps(p["log_step"], networks) if design.coded else None,
    )


def tagged(arrays, tag):
    """Copies of the arrays whose names begin with the tag and a slash, without these."""
    return {
        name[len(tag) + 1 :]: a.copy() for name, a in arrays.items() if name.startswith(f"{tag}/")
    }


class Trainer(Loop):
    """Fits one scene: `step()` does one iteration, `model()` returns the model so far.

    A `design` takes the place of the preset's, for example one with D3DGS's deformation network.
    """

    def __init__(self, scene, preset, seed=0, settings=FAST, points=None, design=None):
        super().__init__(scene, preset, seed, settings)
        self.design = design or design_of(preset, scene.effects)
        self.box: tuple = ()  # the corners of the bounding box, fixed when stage 4 starts
        self.located = None  # where the positions are in the hash grid, from stage 4 on
        self.bodies = {}  # the pixels that count more (B3), by view
        self.factors = []  # how often they count in stages 1 and 2, and at the start of stage 3
        points = scene.points if points is None else points
        self.start(initial_parameters(preset, self.design, self.rng, points))
        self.mask = np.ones((len(self.parameters["x_a"]), self.design.k), bool)
        self.statistics = density.Statistics.empty(*self.mask.shape)

    @property
    def primitives(self):
        """The number of anchors."""
        return len(self.mask)

    def adopt(self, parameters):
        """Take over parameters and find the networks and grids in them."""
        super().adopt(parameters)
        self.networks = {name: parameters.network(name) for name in self.design.layers()}
        self.grids = parameters.listed("grid")
        self.layout = (
            coded_networks.Layout(parameters, self.networks) if self.design.coded else None
        )

    def find_bodies(self):
        """Note the pixels of every training view that count more from this iteration on (B3)."""
        model = self.model()
        for view in self.scene.train:
            pixels = self.bodies[id(view)] = body(view.image)
            if self.iteration:
                drawn = model.render(view.camera, view.time, self.settings)
                pixels &= unlike(view.image, drawn)
        share = np.mean([pixels.mean() for pixels in self.bodies.values()])
        times = 1 / max(share, LEAST_SHARE) if share else 1.0
        self.factors = [*self.factors[: self.iteration > 0], times]

    def weight_of(self, view):
        """The weight of each pixel of a view in L1: [H, W, 1], or 1 where all count alike."""
        _, rested, moved, _ = self.preset.stage_ends
        until = (rested + moved) // 2
        if not self.preset.body or self.iteration >= until:
            return 1.0
        if self.iteration in (0, rested):
            self.find_bodies()
        more = exponential(self.iteration, self.factors[-1], 1.0, until, rested) - 1
        return np.float32(1 + more * self.bodies[id(view)][:, :, None])

    @property
    def stage(self):
        """The stage, 1 to 4, of the next iteration."""
        return self.preset.stage(self.iteration)

    def rate_of(self, name):
        """The current learning rate of a name of LEARNING_RATES; 0 where the stage has none."""
        if self.stage < FIRST_STAGE.get(name, 1) or (name == "x_a" and self.stage == 4):
            return 0.0
        return exponential(
            self.iteration,
            *getattr(self.preset, LEARNING_RATES[name]),
            self.preset.iterations,
            self.preset.decay_from,
        )

    def fixed(self):
        """The inputs of the next iteration besides parameters, view and weights of pixels."""
        preset, stage = self.preset, self.stage
        coded_for = self.iteration - preset.stage_ends[2]  # iterations of stage 4
        return objective.Fixed(
            mask=self.mask,
            located=self.located,
            background=self.scene.background,
            stage=stage,
            lambda_rate=preset.lambda_rate,
            lambda_ssim=preset.lambda_ssim,
            settings=self.settings,
            coded=self.layout if stage == 4 else None,
            network_price=min(coded_for / max(preset.network_ramp, 1), 1.0),  # rises to 1
        )

    def gradients_of(self, view):
        """The Losses of a view, what was Seen, and the gradients of parameters and of mean2d.

        Raises NotFinite with the first equation, array and index that is NaN or infinite.
        """
        if self.stage == 4 and not self.box:
            self.freeze_positions()
            if self.design.coded:
                self.parameters["log_step"][...] = coded_networks.first_log_steps(self.networks)
        u = self.rng.random((len(self.mask), sum(self.design.widths)), np.float32) - np.float32(0.5)
        inputs = (
            self.parameters,
            self.design,
            self.networks,
            self.grids,
            self.fixed()._replace(weight=self.weight_of(view)),
            view,
            u,
            self.moments_of(view),
        )
        losses, seen, back = objective.loss(*inputs)
        gradients, mean2d_bar = back()
        # The opacities are checked too: masking would hide a NaN among them from the loss.
        watched = (losses.L_total, gradients.vector, seen.alpha)
        if not all(np.isfinite(values).all() for values in watched):
            raise NotFinite(f"iteration {self.iteration}: {find_first(*inputs)}")
        return losses, seen, gradients, mean2d_bar

    def freeze_positions(self):
        """Put the positions on the lattice of the box and find them in the hash grid.

        The box is fixed the first time, when stage 4 starts.
        """
        x_a, tables = self.parameters["x_a"], [T for T, _ in self.design.levels()]
        lo, hi = self.box = self.box or bounding_box(x_a)
        x_a[...] = snap(x_a, lo, hi, self.design.position_bits)[1]
        self.located = hash_grid.locate(x_a, lo, hi, self.design.grid, tables)

    def adjust(self):
        """Grow, re-seed, prune and mask as the preset says.

        Then a new window starts, with Scaffold-GS's rule only for what has been judged.
        """
        preset, statistics, now = self.preset, self.statistics, self.iteration
        if now >= preset.mask_from:
            self.mask &= ~density.faint_children(statistics, preset)
        dead = density.dead_anchors(statistics, self.mask, preset)
        growing = preset.grow_from < now < preset.grow_until
        p, adam = self.parameters, self.adam
        if preset.grow == "reseed" and growing:
            density.reseed(p, adam.first, adam.second, dead, statistics, self.rng)
            self.mask[dead] = True
        elif preset.grow == "reseed" and now >= preset.grow_until:
            self.keep_rows(~dead)  # too late to learn something new: they only cost bytes
        elif preset.grow == "scaffold" and growing:
            self.keep_rows(~dead, density.grow(p, statistics, preset, self.rng))
            log_s = self.parameters["log_s"]
            log_s[...] = np.minimum(log_s, density.LARGEST_LOG_SCALE)
        if preset.grow != "scaffold":
            self.statistics = density.Statistics.empty(*self.mask.shape)
        elif growing or now >= preset.mask_from:
            self.statistics.clear_judged(preset)

    def keep_rows(self, keep, added=None):
        """Drop anchors and append new ones, with their masks, moments and statistics.

        The last anchor is never dropped.
        """
        added = added or {name: self.parameters[name][:0] for name in density.ROWS}
        count = len(added["x_a"])
        if not keep.any() and not count:
            keep = np.arange(len(keep)) == 0
        self.change_rows(density.ROWS, keep, added)
        self.mask = np.concatenate([self.mask[keep], np.ones((count, self.design.k), bool)])
        self.statistics = self.statistics.with_rows(keep, count)
        if self.box:
            self.freeze_positions()

    def model(self):
        """The model as it is now, before rounding."""
        return assemble(self.parameters, self.design, self.mask, self.box, self.scene.background)

    def state(self):
        """All that another process needs to go on: arrays by name, and JSON values by name."""
        groups = {
            "p": self.parameters.arrays,
            "m": self.adam.first.arrays,
            "v": self.adam.second.arrays,
            "stat": vars(self.statistics),
            "body": {str(i): pixels for i, pixels in enumerate(self.bodies.values())},
        }
        arrays = {f"{tag}/{name}": a for tag, group in groups.items() for name, a in group.items()}
        arrays.update(mask=self.mask, order=self.order, box=np.array(self.box))
        return arrays, {
            "iteration": self.iteration,
            "steps": self.adam.steps,
            "rng": self.rng.bit_generator.state,
            "history": self.history,
            "factors": self.factors,
        }

    def restore(self, arrays, values):
        """Take over copies of what `state` returned."""
        self.adopt(Parameters(tagged(arrays, "p")))
        self.adam.first = Parameters(tagged(arrays, "m"))
        self.adam.second = Parameters(tagged(arrays, "v"))
        self.adam.steps = {**values["steps"]}
        self.statistics = density.Statistics(**tagged(arrays, "stat"))
        self.order, self.iteration = arrays["order"], values["iteration"]
        self.rng.bit_generator.state, self.history = values["rng"], [*values["history"]]
        self.bodies = dict(zip(map(id, self.scene.train), tagged(arrays, "body").values()))
        self.factors = [*values["factors"]]
        self.mask, self.box = arrays["mask"].copy(), tuple(arrays["box"])
        if self.box:
            self.freeze_positions()
