"""What an effect costs: multiply-adds counted while its equations run, and bytes of its weights in a file.

Everything is attributed to the effect that alone needs it.  What effects share (the trunk of psi_d, Eq. 2) is
divided evenly among those of them that are on; what every build needs belongs to none.
"""

from collections import Counter
from contextlib import contextmanager

import numpy as np

from .. import effects as fx
from ..codec.file import decode
from ..model import ANCHOR_NETWORKS
from ..training.finite import intercepted

VIEW = ("view_color", "view_geometry")
SEES = {
    "opacity": "view_geometry",
    "rotation": "view_geometry",
    "scale": "view_geometry",
    "color": "view_color",
}
PRODUCTS = {
    "forward": 1,
    "backward": 2,
}  # a product with weights W has two in its backward: of x and of W
EQUATION_2 = {
    "forward": 6,
    "backward": 12,
}  # multiplications, divisions and additions of products, per anchor


class Work:
    """Calls of equations, {(equation, function): calls}, and multiply-adds of effects, {effect: multiply-adds}."""

    def __init__(self):
        self.calls, self.own, self.view = Counter(), Counter(), 0

    def add(self, key, name, res):
        """Take note of one call; `res` is the residual that ties its forward to its backward."""
        self.calls[key, name] += 1
        if key == "view":
            delta_vc, _ = res
            self.view += EQUATION_2[name] * len(delta_vc)
        elif key in SEES:
            (inputs, weights), d = res[-1]
            rows, width = inputs[0].shape
            self.own[SEES[key]] += PRODUCTS[name] * rows * (width - d) * weights[0].shape[1]
        elif key == "deformation":
            self.own.update(_deformation(res, name))
        elif key == "deformed":
            r_t, _, widths = res
            self.own.update({effect: len(r_t) * n for effect, n in zip(fx.MOTION, widths)})
        elif key == "compositing, fast":
            chunks, _, _, T, _, _, background, occlusion, _ = res
            pixels = sum(chunk.A.size for chunk in chunks)
            self.own["occlusion"] += 2 * pixels * bool(occlusion)  # weight and transmittance
            self.own["background"] += 3 * T.size * bool(background.any())

    def of(self, effect):
        """Multiply-adds of an effect, its part of what it shares included."""
        seeing = [name for name in VIEW if self.own[name]]
        return self.own[effect] + (self.view / len(seeing) if effect in seeing else 0)


def _deformation(res, name):
    """Multiply-adds of Eq. (5) by effect: the heads their own, encoding and trunk in equal parts."""
    _, E_t, (layer_inputs, weights), cuts = res
    N, shapes = len(layer_inputs[0]), [W.shape for W in weights]
    widths = np.diff([0, *cuts, shapes[-1][1]])
    trunk = [rows * columns for rows, columns in shapes[:-1]]
    inputs = sum(trunk[1:]) if name == "backward" else 0  # no gradient of E(x) is asked for (Q10)
    encoding = N * shapes[0][0] if name == "forward" else 0
    shared = N * (sum(trunk) + inputs) + encoding + E_t.size * shapes[0][1]
    on = sum(width > 0 for width in widths)
    return {
        effect: PRODUCTS[name] * N * shapes[-1][0] * width + shared / on
        for effect, width in zip(fx.MOTION, widths)
        if width
    }


@contextmanager
def counted():
    """Within it, equations count their work: `with counted() as work: trainer.step()`."""
    work = Work()

    def count(key, name, function):
        def run(*args, **kwargs):
            result = function(*args, **kwargs)
            work.add(key, name, result[1] if name == "forward" else args[0])
            return result

        return run

    with intercepted(count):
        yield work


def effect_bytes(data):
    """Bytes of each effect's weights in a file, {effect: bytes}; effects without weights (occlusion) have none."""
    model = decode(data)
    design, sizes = model.design, Counter()
    for net in ANCHOR_NETWORKS:
        W = model.networks[net][0][0]
        sizes["view_color" if net == "psi_c" else "view_geometry"] += (
            2 * (len(W) - design.d) * W.shape[1]
        )
    if "psi_d" in model.networks:
        weights, biases = model.networks["psi_d"]
        numbers = [W.size + b.size for W, b in zip(weights, biases)]
        on = [(effect, count) for effect, count in zip(fx.MOTION, numbers[-3:]) if count]
        sizes.update({effect: 2 * (count + sum(numbers[:-3]) / len(on)) for effect, count in on})
    return sizes
