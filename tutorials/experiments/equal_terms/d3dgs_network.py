"""P-4DGS with the deformation network of D3DGS in the place of its own (Q1), for the ablation."""

from dataclasses import dataclass

from p4dgs_ref import effects as fx
from p4dgs_ref import model
from p4dgs_ref.equations import deformed
from p4dgs_ref.model import predict, with_backward
from p4dgs_ref.training import trainer
from . import deformation_d3dgs


def deformation_layers(L_x, L_t, widths, heads, time_net=(), skip=False):
    """The shapes of psi_d, which ends with its heads, and of psi_t where there is a time net."""
    time = (1 + 2 * L_t, *time_net)
    inputs = 3 * (1 + 2 * L_x) + time[-1]
    trunk = [*zip((inputs, *widths), widths)]
    if skip:
        after = len(trunk) // 2 + 1
        rows, columns = trunk[after]
        trunk[after] = inputs + rows, columns
    layers = {"psi_d": trunk + [(widths[-1], head) for head in heads]}
    if time_net:
        layers["psi_t"] = [*zip(time[:-1], time[1:])]
    return layers


@dataclass(frozen=True)
class Design(model.Design):
    """The paper's Design with another psi_d."""

    time_net: tuple = ()  # hidden widths of psi_t, then the width of its output
    skip: bool = False  # whether psi_d's layer after the middle takes its inputs once more

    def layers(self):
        """The shapes of all layers, as of the paper's Design."""
        heads, network = fx.heads(self.effects), (self.time_net, self.skip)
        layers = deformation_layers(self.L_x, self.L_t, self.deformation, heads, *network)
        return super().layers() | (layers if fx.moves(self.effects) else {})


def move(design, networks, x, s, r, t):
    """Like `model.move`, with D3."""
    layers = *networks["psi_d"], *networks.get("psi_t", ([], []))
    deltas, back_deltas = with_backward(deformation_d3dgs, x, t, *layers, design.L_x, design.L_t)
    at_t, back_at_t = with_backward(deformed, x, s, r, *deltas)

    def back(x_t_bar, s_t_bar, r_t_bar):
        bars = back_at_t(x_t_bar, s_t_bar, r_t_bar)
        psi = back_deltas(bars["delta_x"], bars["delta_s"], bars["delta_r"], needs_x=False)
        networks_bar = {"psi_d": psi}
        if psi["time_weights"]:
            networks_bar["psi_t"] = {"weights": psi["time_weights"], "biases": psi["time_biases"]}
        return bars["x"], bars["s"], bars["r"], networks_bar

    return at_t, back


class Model(model.Model):
    """The paper's Model, moved by `move`."""

    move = staticmethod(move)

    def gaussians(self, t, camera):
        """The Gaussians at time t in [0, 1] for this camera."""
        x_c = camera.center.astype(self.anchors.x_a.dtype)
        return predict(self.design, self.networks, self.anchors, x_c, t, self.move)[0]


class Trainer(trainer.Trainer):
    """Fits one scene; `network` has the fields of the Design that are those of D3DGS."""

    learning_rates = {**trainer.LEARNING_RATES, "psi_t": "lr_d"}
    first_stage = {**trainer.FIRST_STAGE, "psi_t": 3}

    def __init__(self, scene, preset, seed, network):
        self.network = network
        super().__init__(scene, preset, seed)

    def design_of(self, preset, effects):
        """The Design of the preset with the other network."""
        return Design(**{**vars(trainer.design_of(preset, effects)), **self.network})

    def step_inputs(self, view):
        """Those of the paper with `move`."""
        return super().step_inputs(view)._replace(move=move)

    def assemble(self, *arguments):
        """The model of some parameters."""
        return Model(**vars(trainer.assemble(*arguments)))
