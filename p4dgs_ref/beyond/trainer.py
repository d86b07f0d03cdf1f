"""The training of P-4DGS with coded networks (B1), few bits of a position (B2) and bodies (B3)."""

import numpy as np

from ..table import EQUATIONS
from ..training import initial, objective, trainer
from ..training.fit import disagreements
from ..training.parameters import Parameters, exponential
from ..training.watch import find_first
from . import BEYOND
from .body import MIN_SHARE, body
from .model import Model
from .networks import Layout, initial_log_steps, learned_steps, rounded_networks
from .positions import snap
from .presets import design_of


def initial_parameters(preset, design, rng, points=None):
    """The Parameters before training; coded networks have the logarithms of steps, log_step."""
    p = initial.initial_parameters(preset, design, rng, points)
    if not preset.is_coded:
        return p
    log_step = initial_log_steps({name: p.network(name) for name in design.layers()})
    return Parameters({**p.arrays, "log_step": log_step})


def assemble(p, design, mask, box, background):
    """The model of some parameters, linear and in float64; without a box, the exact one."""
    model = trainer.assemble(p, design, mask, box, background)
    if "log_step" not in p.arrays:
        return model
    return Model(**vars(model), steps=learned_steps(p["log_step"], model.networks))


def loss(layout, price, p, design, networks, grids, inputs, *rest):
    """Like `objective.loss`, with rounded networks that draw and pay `price` for each bit (B1)."""
    rounded, R_networks, back_networks = rounded_networks(p, layout)
    inputs = inputs._replace(R_more=price * R_networks)
    losses, rendered, back_paper = objective.loss(p, design, rounded, grids, inputs, *rest)

    def back():
        gradients, mean2d_bar = back_paper()
        coded_numbers = len(inputs.mask) * sum(design.widths)
        back_networks(gradients, price * inputs.lambda_rate / coded_numbers)
        return gradients, mean2d_bar

    return losses, rendered, back


class Trainer(trainer.Trainer):
    """Fits one scene by a preset of `beyond.presets`."""

    learning_rates = {**trainer.LEARNING_RATES, "log_step": "lr_step"}
    first_stage = {**trainer.FIRST_STAGE, "log_step": 4}
    design_of = staticmethod(design_of)
    initial_parameters = staticmethod(initial_parameters)
    assemble = staticmethod(assemble)

    def __init__(self, scene, preset, *arguments, **options):
        self.bodies = {}  # the pixels that count more (B3), by view
        self.factors = []  # how often they count in stages 1 and 2, and at the start of stage 3
        super().__init__(scene, preset, *arguments, **options)

    # --- coded networks and positions (B1, B2) ----------------------------------------------------
    def adopt(self, parameters):
        """Take over parameters, and find where the networks are in them."""
        super().adopt(parameters)
        self.layout = Layout(parameters, self.networks) if self.preset.is_coded else None

    def freeze_positions(self):
        """Like the paper's; the first time, learning of the steps begins at the default ones."""
        if self.preset.is_coded and not self.box:
            self.parameters["log_step"][...] = initial_log_steps(self.networks)
        super().freeze_positions()

    def on_lattice(self, x_a, lo, hi):
        """The positions on the lattice of a file that are nearest to some positions."""
        return snap(x_a, lo, hi, self.preset.position_bits)[1]

    def loss(self, *inputs):
        """The paper's loss, from stage 4 on with coded networks."""
        if self.stage < 4 or not self.preset.is_coded:
            return super().loss(*inputs)
        iterations = self.iteration - self.preset.stage_ends[2]  # of stage 4
        price = min(iterations / max(self.preset.network_ramp, 1), 1.0)  # rises to 1
        return loss(self.layout, price, *inputs)

    def find_first(self, inputs):
        """Where an iteration with these inputs first stops being finite."""
        return find_first(self.loss, inputs, EQUATIONS | BEYOND)

    # --- bodies that move (B3) --------------------------------------------------------------------
    def step_inputs(self, view):
        """The paper's StepInputs, with a weight of each pixel."""
        return super().step_inputs(view)._replace(weight=self.weight_of(view))

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

    def find_bodies(self):
        """Note the pixels of every training view that count more from this iteration on."""
        model = self.model()
        for view in self.scene.train:
            pixels = self.bodies[id(view)] = body(view.image)
            if self.iteration:
                drawn = model.render(view.camera, view.time, self.settings)
                pixels &= disagreements(view.image, drawn)
        share = np.mean([pixels.mean() for pixels in self.bodies.values()])
        times = 1 / max(share, MIN_SHARE) if share else 1.0
        self.factors = [*self.factors[: self.iteration > 0], times]

    def state(self):
        """The paper's state, and the bodies."""
        arrays, values = super().state()
        pixels = {f"body/{i}": pixels for i, pixels in enumerate(self.bodies.values())}
        return {**arrays, **pixels}, {**values, "factors": self.factors}

    def restore(self, arrays, values):
        """Take over copies of what `state` returned."""
        super().restore(arrays, values)
        pixels = trainer.tagged(arrays, "body").values()
        self.bodies = dict(zip(map(id, self.scene.train), pixels))
        self.factors = [*values["factors"]]
