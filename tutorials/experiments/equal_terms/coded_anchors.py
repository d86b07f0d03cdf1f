"""The paper's design in the simple codec (`coded`), after its training.

Its attributes are coded as the paper codes them, with the steps and the context that were learned.
All its other numbers follow the rule of the explicit methods: positions are sorted and have as many
bits as the pictures need, and so do weights and biases. Only those of the context, which draw
nothing, have the default steps of B1. The head is of the same kind, JSON compressed by zlib. A file
has the parts positions, networks, and the sections of the paper's file with attributes, masks and
hash grid.
"""

import json
from dataclasses import replace

import numpy as np

from p4dgs_ref.codec.file import decode_attributes, sections_of
from p4dgs_ref.codec.header import read_header, write_header
from p4dgs_ref.codec.quantise import quantise_attributes
from p4dgs_ref.model import CONTEXT_NETWORKS, Anchors, Model, predict, with_backward
from p4dgs_ref.splatting import render
from p4dgs_ref.training.parameters import Parameters

from ..baselines.explicit import of_network
from ..coded_networks import positions, weights
from ..coded_networks.networks import default_steps
from .coded import bits_for, codes_of, kinds
from .half import join, split

SECTIONS = "features", "scales", "offset_scales", "offsets", "masks", "hash_grid"


class OfAnchors:
    """A model of anchors in the form that `coded` reads, which is that of an explicit method.

    It has all children of every anchor, and the networks that draw. `parameters` are trained ones:
    logarithms where training has logarithms (Q5).
    """

    def __init__(self, model):
        anchors = model.anchors
        self.model = model
        with np.errstate(divide="ignore"):  # a scale in a file may be 0
            logs = {"log_s": np.log(anchors.s_a), "log_l": np.log(anchors.l_a)}
        arrays = {"x": anchors.x_a, "f_a": anchors.f_a, **logs, "O_a": anchors.O_a}
        for name, network in model.networks.items():
            if name not in CONTEXT_NETWORKS:
                arrays |= of_network(name, *network)
        self.parameters = Parameters(arrays, float)

    def predict(self, t, x_c):
        """The Gaussians at time t, and `back`, as of an explicit method."""
        model, anchors = self.model, self.model.anchors
        g, _, back_predict = predict(model.design, model.networks, anchors, x_c, t)
        return g, lambda *bars: self.gradients(*back_predict(*bars))

    def gradients(self, attributes, networks):
        """The gradients of the trained numbers, from those that `model.predict` returns."""
        gradients = {
            "x": attributes["x_a"],
            "f_a": attributes["f_a"],
            "log_s": attributes["s_a"] * self.model.anchors.s_a,
            "log_l": attributes["l_a"] * self.model.anchors.l_a,
            "O_a": attributes["O_a"],
        }
        for name, psi in networks.items():
            gradients |= of_network(name, psi["weights"], psi["biases"])
        return gradients

    def render_gaussians(self, g, camera, settings):
        """The picture of some Gaussians, and its backward."""
        looks = camera, self.model.background, settings, "occlusion" in self.model.design.effects
        return with_backward(render, *g[:5], *looks)


def encode(model, H, loss):
    """The file of a model of the paper's design, from the sensitivity H of its `OfAnchors`."""
    bits, steps = bits_for(loss, H["x"], model.box), default_steps(model.networks)
    for name in set(steps) - set(CONTEXT_NETWORKS):
        steps[name] = codes_of(loss, H.network(name), model.networks[name])
    places, x_a = positions.snap(model.anchors.x_a, *model.box, bits)
    order = positions.codes_of(places, model.box, bits).argsort(kind="stable")
    anchors = Anchors(*(array[order] for array in model.anchors._replace(x_a=x_a)))
    networks = weights.round_networks(model.networks, steps)
    rounded = replace(model, anchors=anchors, networks=networks)
    quantised = quantise_attributes(rounded, places[order])
    sections = sections_of(quantised)
    parts = {
        "positions": positions.write_sorted(quantised.positions, model.box, bits),
        "networks": weights.write_weights(quantised.model.networks, steps),
        **{name: sections[name] for name in SECTIONS},
    }
    data = join({"header": json.loads(write_header(quantised.model)), "bits": bits}, parts)
    return data, kinds(data, parts)


def decode(data):
    """The model in such a file."""
    values, parts = split(data)
    design, A, background = read_header(json.dumps(values["header"]).encode())
    box, places = positions.read_sorted(parts["positions"], A, values["bits"])
    networks = weights.read_networks(parts["networks"], "networks", design.layers())
    model = Model(design, None, networks, [], box, background)
    return decode_attributes(parts, model, places).model
