"""Models of anchors in the simple codec (`coded`), after their training."""

import numpy as np

from p4dgs_ref.attributes import ATTRIBUTES
from p4dgs_ref.beyond.model import Design, Model
from p4dgs_ref.beyond.networks import default_steps
from p4dgs_ref.model import CONTEXT_NETWORKS, bounding_box, move, predict, with_backward
from p4dgs_ref.splatting import render
from p4dgs_ref.training.parameters import Parameters
from .coded import codes_of, sensitivity
from .explicit import of_network


class OfAnchors:
    """A model of anchors in the form that this codec reads, which is that of a baseline.

    It has all children of every anchor, and the networks that draw. `parameters` are trained ones:
    logarithms where training has logarithms (Q5).
    """

    def __init__(self, model):
        self.model, self.box = model, bounding_box(model.anchors.x_a)
        arrays = {"x": model.anchors.x_a}
        for row in ATTRIBUTES:
            values = getattr(model.anchors, row.name)
            with np.errstate(divide="ignore"):  # a scale in a file may be 0
                arrays[row.parameter] = np.log(values) if row.is_log else values
        self.rows = [*arrays]
        for name, network in model.networks.items():
            if name not in CONTEXT_NETWORKS:
                arrays |= of_network(name, *network)
        self.parameters = Parameters(arrays, float)

    def predict(self, t, x_c):
        """The Gaussians at time t, and `back`, as of a baseline."""
        anchors, move_by = self.model.anchors, getattr(self.model, "move", move)
        g, _, back_predict = predict(
            self.model.design, self.model.networks, anchors, x_c, t, move_by
        )

        def back(*bars):
            attributes, networks = back_predict(*bars)
            gradients = {"x": attributes["x_a"]}
            for row in ATTRIBUTES:
                slope = getattr(anchors, row.name) if row.is_log else 1.0
                gradients[row.parameter] = slope * attributes[row.name]
            for name, psi in networks.items():
                gradients |= of_network(name, psi["weights"], psi["biases"])
            return gradients

        return g, back

    def render_gaussians(self, g, camera, settings):
        """The picture of some Gaussians, and its backward."""
        looks = camera, self.model.background, settings, "occlusion" in self.model.design.effects
        return with_backward(render, *g[:5], *looks)

    def values(self):
        """What a file says besides the numbers."""
        arrays = self.parameters.arrays
        return {
            "design": str(vars(self.model.design)),
            "background": [float(c) for c in self.model.background],
            "rows": {name: arrays[name].shape[1:] for name in self.rows},
            "shapes": {name: a.shape for name, a in arrays.items() if name not in self.rows},
        }


def with_steps(model, views, rng, loss):
    """A model of the paper's design as one of ours, whose networks have steps by `loss` (B1).

    Those of the networks of the context, which draw no pixel, are the default ones.
    """
    H, steps = sensitivity(OfAnchors(model), views, rng), default_steps(model.networks)
    for name in set(steps) - set(CONTEXT_NETWORKS):
        steps[name] = codes_of(loss, H.network(name), model.networks[name])
    design = Design(**vars(model.design))
    return Model(**{**vars(model), "design": design}, steps=steps)
