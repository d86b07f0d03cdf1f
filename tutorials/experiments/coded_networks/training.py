"""The training of P-4DGS with coded networks (B1) and few bits of a position (B2)."""

from dataclasses import dataclass

import numpy as np

from p4dgs_ref.model import Model, bounding_box
from p4dgs_ref.training import trainer
from p4dgs_ref.training.parameters import Adam, Parameters, learning_rate_at

from .networks import Layout, initial_log_steps, learned_steps, rounded_networks
from .positions import snap

NETWORK_RAMP = 1000  # iterations of stage 4 until networks pay fully
POSITION_BITS = 10  # per axis
LR_STEP = 0.02, 0.002  # learning rates of the logarithms of steps, first and last


@dataclass(frozen=True, eq=False)
class CodedModel(Model):
    """The paper's Model, and what its file of version 2 holds besides."""

    steps: dict[str, tuple[np.ndarray, np.ndarray]]  # codes for all weights and biases (B1)
    position_bits: int  # per axis (B2)


class Trainer(trainer.Trainer):
    """Fits one scene by a preset of the paper."""

    def __init__(self, scene, preset, seed=0):
        super().__init__(scene, preset, seed)
        log_step = initial_log_steps(self.networks)  # one for each tensor of a network
        self.adopt(Parameters({**self.parameters.arrays, "log_step": log_step}))
        self.adam = Adam(self.parameters)

    def adopt(self, parameters):
        """Take over parameters, and find where the networks are in them."""
        super().adopt(parameters)
        self.layout = Layout(parameters, self.networks)

    def learning_rate(self, name):
        """The current learning rate of a name; steps take part in stage 4."""
        if name != "log_step":
            return super().learning_rate(name)
        schedule = *LR_STEP, self.preset.iterations, self.preset.decay_from
        return learning_rate_at(self.iteration, *schedule) if self.stage == 4 else 0.0

    def freeze_positions(self):
        """Put positions on the lattice of few bits, which is a part of the paper's.

        The first time, when the box is fixed, learning of the steps begins at the default ones.
        """
        p = self.parameters
        if not self.box:
            self.box = bounding_box(p["x_a"])
            p["log_step"][...] = initial_log_steps(self.networks)
        p["x_a"][...] = snap(p["x_a"], *self.box, POSITION_BITS)[1]
        super().freeze_positions()

    def gradients_of(self, view):
        """Like the paper's; in stage 4 rounded networks draw, and pay for each bit.

        Bits are added to the loss, so they and their gradients are added to what the paper has.
        """
        if self.stage < 4:
            return super().gradients_of(view)
        if not self.box:
            self.freeze_positions()
        self.networks, bits, back = rounded_networks(self.parameters, self.layout)
        losses, rendered, gradients, mean2d_bar = super().gradients_of(view)
        iterations = self.iteration - self.preset.stage_ends[2]  # of stage 4
        price = min(iterations / NETWORK_RAMP, 1.0)  # rises to 1
        price_of_rate = price / (len(self.mask) * sum(self.design.widths))  # per coded number
        back(gradients, self.preset.lambda_rate * price_of_rate)
        more = price_of_rate * bits
        losses = losses._replace(
            L_total=losses.L_total + self.preset.lambda_rate * more,
            L_rate=losses.L_rate + more,
            bits=losses.bits + price * bits,
        )
        return losses, rendered, gradients, mean2d_bar

    def model(self):
        """The model as it is now, before rounding."""
        model = super().model()
        steps = learned_steps(self.parameters["log_step"], model.networks)
        return CodedModel(**vars(model), steps=steps, position_bits=POSITION_BITS)
