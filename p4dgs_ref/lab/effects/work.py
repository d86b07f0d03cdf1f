"""What an effect costs: counted multiply-adds of its equations, and bytes of its weights in a file.

Work belongs to the effect that alone needs it. What several effects share (the trunk of psi_d,
Eq. 2) is divided evenly among those that are on; what every scene needs belongs to none.
"""

from collections import Counter
from contextlib import contextmanager

import numpy as np

from ... import effects as fx
from ...codec.file import NETWORK_SECTIONS, decode, network_numbers
from ...model import ANCHOR_NETWORKS
from ...report.inspect import components
from ...training.watch import equation_codes, watching

VIEW = ("view_color", "view_geometry")
SEES = {  # the effect that an equation of an anchor's networks looks at
    **dict.fromkeys(("opacity", "rotation", "scale"), "view_geometry"),
    "color": "view_color",
}
# The backward of a product has two products: one for the input and one for the weights.
PRODUCTS = {"forward": 1, "backward": 2}
EQUATION_2 = 6  # multiplications, divisions and additions of a product in Eq. (2), per anchor


class Work:
    """Counts calls, {(equation, function): calls}, and multiply-adds, {effect: multiply-adds}.

    `sorted` counts Gaussians that were brought into the order of their depth.
    """

    def __init__(self):
        self.calls, self.own, self.sorted = Counter(), Counter(), Counter()

    def add(self, key, name, saved):
        """Count one call of an equation; `saved` is what its forward returns for its backward."""
        self.calls[key, name] += 1
        if key == "view":
            delta_vc, _ = saved
            self.own["view"] += PRODUCTS[name] * EQUATION_2 * len(delta_vc)
        elif key in SEES:
            (inputs, weights), d = saved[-1]
            rows, width = inputs[0].shape
            self.own[SEES[key]] += PRODUCTS[name] * rows * (width - d) * weights[0].shape[1]
        elif key == "deformation":
            self.own.update(deformation_work(saved, name))
        elif key == "deformed":
            r_t, _, widths = saved
            self.own.update({effect: len(r_t) * n for effect, n in zip(fx.MOTION, widths)})
        elif key == "compositing, fast":
            chunks, T, background, occlusion, lists, *_ = saved
            pairs = sum(A.size for _, _, A, *_ in chunks)
            self.own["occlusion"] += 2 * pairs * bool(occlusion)  # weight and transmittance
            self.own["background"] += 3 * T.size * bool(background.any())
            sorts = occlusion and name == "forward"
            self.sorted["occlusion"] += len(np.unique(lists.row)) * bool(sorts)

    def of(self, effect):
        """Multiply-adds of an effect, with its part of shared work."""
        seeing = [name for name in VIEW if self.own[name]]
        return self.own[effect] + (self.own["view"] / len(seeing) if effect in seeing else 0)


def deformation_work(saved, name):
    """Multiply-adds of Eq. (5) by effect. Encoding and trunk are shared, the heads are not."""
    _, E_t, (layer_inputs, weights), cuts = saved
    N, shapes = len(layer_inputs[0]), [W.shape for W in weights]
    widths = np.diff([0, *cuts, shapes[-1][1]])
    trunk = [rows * columns for rows, columns in shapes[:-1]]
    inputs = sum(trunk[1:]) if name == "backward" else 0  # E(x) needs no gradient (Q10)
    encoding = N * shapes[0][0] if name == "forward" else 0
    shared = N * (sum(trunk) + inputs) + encoding + E_t.size * shapes[0][1]
    on = {effect: width for effect, width in zip(fx.MOTION, widths) if width}
    head = PRODUCTS[name] * N * shapes[-1][0]
    return {effect: head * width + shared / len(on) for effect, width in on.items()}


@contextmanager
def counted():
    """A `with` block that counts the work of the equations in it; gives the Work."""
    work = Work()

    def see(event, mark, frame, value):
        if event == "return":
            key, name = mark
            work.add(key, name, value[1] if name == "forward" else frame.f_locals["saved"])

    with watching(equation_codes(), see):
        yield work


def effect_bytes(data):
    """{effect: bytes of its weights in a file}; effects without weights have none.

    Every weight has the mean size of its section: two bytes, unless networks are coded (B1).
    """
    model, parts = decode(data), components(data)
    sizes, each = Counter(), {}
    for section, members in NETWORK_SECTIONS.items():
        networks = {name: model.networks[name] for name in members if name in model.networks}
        if networks:
            each[section] = parts[section] / network_numbers(networks).size
    for net in ANCHOR_NETWORKS:
        inputs, units = model.networks[net][0][0].shape
        sizes[VIEW[net != "psi_c"]] += each["anchor_mlps"] * (inputs - model.design.d) * units
    if "psi_d" in model.networks:
        numbers = [W.size + b.size for W, b in zip(*model.networks["psi_d"])]
        heads = {effect: n for effect, n in zip(fx.MOTION, numbers[-3:]) if n}
        time_net = [W.size + b.size for W, b in zip(*model.networks.get("psi_t", ((), ())))]
        shared = sum(numbers[:-3] + time_net) / len(heads)
        sizes.update({e: each["deformation_mlp"] * (n + shared) for e, n in heads.items()})
    return sizes
