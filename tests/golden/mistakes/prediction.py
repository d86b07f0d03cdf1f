"""Known mistakes in Eqs. (1) to (4), masking and the networks."""

import numpy as np

from p4dgs_ref.equations.numerics import normalise
from p4dgs_ref.table import EQUATIONS
from tests.golden.mistakes.kit import (
    bars_of,
    component_major,
    elementwise,
    exponential,
    first_rows,
    hac_order,
    headed,
    identity,
    known,
    no_gradient,
    relu,
    sigmoid,
    surgery,
    tanh,
    without,
)

HAC = "the networks' input is (f_a, d_vc, delta_vc), HAC's order, instead of (f_a, delta_vc, d_vc)"


# --- Eq. (1) ------------------------------------------------------------------------------------
def first_axis_bar(bar, _):
    return np.stack([bar.sum(axis=1), 0 * bar[:, 0], 0 * bar[:, 0]], axis=1)


OFFSETS = [
    known(
        "offsets",
        "offsets-not-scaled",
        "the offsets are added without l_a",
        inputs={"l_a": np.ones_like},
        inputs_bar={"l_a": no_gradient},
    ),
    known(
        "offsets",
        "offsets-log-reach",
        "l_a is taken for a logarithm: exp(l_a) scales the offsets",
        inputs={"l_a": np.exp},
        inputs_bar={"l_a": lambda bar, l_a: bar * np.exp(l_a)},
    ),
    known(
        "offsets",
        "offsets-one-reach",
        "the first component of l_a scales all three axes",
        inputs={"l_a": lambda l_a: np.repeat(l_a[:, :1], 3, axis=1)},
        inputs_bar={"l_a": first_axis_bar},
    ),
    known(
        "offsets",
        "offsets-coordinate-major",
        "O_a is stored coordinate by coordinate, (3, k) instead of (k, 3)",
        inputs={"O_a": lambda O: O.reshape(len(O), 3, -1).swapaxes(1, 2)},
        inputs_bar={"O_a": lambda bar, O: bar.swapaxes(1, 2).reshape(O.shape)},
    ),
    known("offsets", "offsets-no-anchor", "the anchor's position is not added", **without("x_a")),
    known(
        "offsets",
        "offsets-mean-gradient",
        "the gradient of x_a is the mean over the children instead of the sum",
        inputs_bar=lambda bars, given: {**bars, "x_a": bars["x_a"] / given["O_a"].shape[1]},
    ),
    known(
        "offsets",
        "offsets-log-gradient",
        "the gradient of l_a is that of log l_a: it has one factor l_a too many",
        inputs_bar={"l_a": lambda bar, l_a: bar * l_a},
    ),
]


# --- Eq. (2) ------------------------------------------------------------------------------------
EPSILON = 1e-6


def softened(out, _):
    return {**out, "d_vc": out["d_vc"] * (out["delta_vc"] / (out["delta_vc"] + EPSILON))}


def softened_bar(bars, out, _):
    delta, d = out["delta_vc"], out["d_vc"]
    along = (bars["d_vc"] * d).sum(axis=1, keepdims=True)
    at_camera = delta == 0
    # An anchor on the camera has the direction v / EPSILON; the right gradient is 0 there.
    return {
        "delta_vc": bars["delta_vc"]
        + np.where(at_camera, 0, along * (EPSILON / (delta + EPSILON)) / (delta + EPSILON)),
        "d_vc": bars["d_vc"] * (delta / (delta + EPSILON)),
    }


def radial_bar(bars, out, _):
    delta = np.where(out["delta_vc"] > 0, out["delta_vc"], np.inf)
    return {
        **bars,
        "delta_vc": bars["delta_vc"]
        + (bars["d_vc"] * out["d_vc"]).sum(axis=1, keepdims=True) / delta,
    }


VIEW = [
    known(
        "view",
        "view-toward-camera",
        "d_vc points from the anchor to the camera, not from the camera to the anchor",
        outputs={"d_vc": np.negative},
        outputs_bar={"d_vc": lambda bar, _: -bar},
    ),
    known(
        "view",
        "view-squared-distance",
        "delta_vc is the squared distance: the root is missing",
        outputs={"delta_vc": np.square},
        outputs_bar={"delta_vc": lambda bar, delta: 2 * bar * delta},
    ),
    known(
        "view",
        "view-epsilon",
        "d_vc is divided by delta_vc + 1e-6 instead of delta_vc",
        outputs=softened,
        outputs_bar=softened_bar,
    ),
    known(
        "view",
        "view-radial-gradient",
        "the gradient of d_vc treats the length in its denominator as a constant",
        outputs_bar=radial_bar,
    ),
]


# --- Eq. (3) ------------------------------------------------------------------------------------
def view_first(given):
    d = given["f_a"].shape[1]
    return np.array([*range(d, len(given["weights"][0])), *range(d)])


def plain_sigmoid(y):
    value = 1 / (1 + np.exp(-y))
    return value, value * (1 - value)


def unsquared(y):
    return np.tanh(y), 1 - np.tanh(y)


def positive(y):
    return np.maximum(np.tanh(y), 0), (1 - np.tanh(y) ** 2) * (y > 0)


OPACITY = [
    headed(
        "opacity", "opacity-sigmoid", "sigmoid for tanh", elementwise("alpha", 0, plain_sigmoid)
    ),
    headed(
        "opacity",
        "opacity-linear",
        "no activation: the tanh is missing",
        elementwise("alpha", 0, identity),
    ),
    headed(
        "opacity",
        "opacity-positive",
        "negative opacities are set to zero",
        elementwise("alpha", 0, positive),
    ),
    headed(
        "opacity",
        "opacity-slope",
        "the slope of tanh is taken as 1 - alpha instead of 1 - alpha^2",
        elementwise("alpha", 0, unsquared),
    ),
    known("opacity", "opacity-hac-order", HAC, **first_rows(hac_order)),
    known(
        "opacity",
        "opacity-view-first",
        "the network's input is (delta_vc, d_vc, f_a): the feature comes last",
        **first_rows(view_first),
    ),
]


# --- masking ------------------------------------------------------------------------------------
def kept_where(**changes):
    """`run` that keeps other rows.

    The cotangents are those of the right rows. The port reads as many of them as it has rows.
    """

    def run(given, cotangents):
        other = {name: f(given) for name, f in changes.items()}
        out, pullback = EQUATIONS["masking"].vjp(**{**given, **other})
        rows = len(out["index"])
        read = {}
        for name, bar in cotangents.items():
            read[name] = np.zeros((rows, *bar.shape[1:]), bar.dtype)
            read[name][: len(bar)] = bar[:rows]
        return out, pullback(**read)

    return run


def child_major(tree, *_):
    return {name: a.swapaxes(0, 1) if np.ndim(a) > 1 else a for name, a in tree.items()}


def packed(bars, given):
    """Put the gradients into the first rows instead of the rows that were kept."""
    index = np.flatnonzero(given["mask"] & (given["alpha"] >= given["tau_alpha"]))
    wrong = {}
    for name, bar in bars.items():
        flat = np.zeros_like(bar).reshape(given["alpha"].size, *bar.shape[2:])
        flat[: len(index)] = bar.reshape(flat.shape)[index]
        wrong[name] = flat.reshape(bar.shape)
    return wrong


MASKING = [
    surgery(
        "masking",
        "masking-strict",
        "alpha > tau_alpha instead of alpha >= tau_alpha",
        kept_where(mask=lambda given: given["mask"] & (given["alpha"] != given["tau_alpha"])),
    ),
    surgery(
        "masking",
        "masking-mask-ignored",
        "children masked for good are drawn: the mask is ignored",
        kept_where(mask=lambda given: np.ones_like(given["mask"])),
    ),
    surgery(
        "masking",
        "masking-threshold-ignored",
        "everything not masked is kept: tau_alpha is ignored",
        kept_where(tau_alpha=lambda _: -np.inf),
    ),
    known(
        "masking",
        "masking-child-major",
        "the list runs child by child over all anchors instead of anchor by anchor",
        inputs=child_major,
        inputs_bar=child_major,
    ),
    known(
        "masking",
        "masking-gradient-packed",
        "gradients are not scattered back: they stay in the first rows",
        inputs_bar=packed,
    ),
]


# --- Eq. (3) for colour and rotation, Eq. (4) ---------------------------------------------------
def half_slope(y):
    return sigmoid(y)[0], sigmoid(y)[0]


def eight_bits(out, _):
    return {"color": np.rint(out["color"] * 255) / 255}


COLOR = [
    headed("color", "color-tanh", "tanh for sigmoid", elementwise("color", 3, tanh)),
    headed(
        "color",
        "color-linear",
        "no activation: the sigmoid is missing",
        elementwise("color", 3, identity),
    ),
    headed(
        "color",
        "color-slope",
        "the slope of the sigmoid lacks its factor 1 - color",
        elementwise("color", 3, half_slope),
    ),
    known(
        "color",
        "color-bgr",
        "the channels are blue, green, red",
        outputs={"color": lambda color: color[..., ::-1]},
        outputs_bar={"color": lambda bar, _: bar[..., ::-1]},
    ),
    known("color", "color-eight-bits", "colours are rounded to 8 bits", outputs=eight_bits),
    known(
        "color",
        "color-channel-major",
        "the outputs are read channel by channel instead of child by child",
        **component_major(3),
    ),
    known("color", "color-hac-order", HAC, **first_rows(hac_order)),
]


def quaternions(value_of, pull_of=None):
    """A head (A, k, 4) with value_of(y) and its gradient pull_of(bar, y), by default the bar."""

    def head(y, _):
        y_4 = y.reshape(len(y), y.shape[1] // 4, 4)
        return {"r": value_of(y_4)}, lambda bars: (
            (pull_of(bars["r"], y_4) if pull_of else bars["r"]).reshape(y.shape),
            {},
        )

    return head


def real_sign(r):
    return np.where(r[..., :1] < 0, -1, 1).astype(r.dtype)


ROTATION = [
    known(
        "rotation",
        "rotation-real-last",
        "the quaternion is returned as (x, y, z, w) instead of (w, x, y, z)",
        outputs={"r": lambda r: r[..., [1, 2, 3, 0]]},
        outputs_bar={"r": lambda bar, _: bar[..., [3, 0, 1, 2]]},
    ),
    headed(
        "rotation",
        "rotation-not-normalised",
        "the quaternion is not normalised",
        quaternions(lambda y: y),
    ),
    headed(
        "rotation",
        "rotation-gradient-not-normalised",
        "the normalisation is missing in backward alone",
        quaternions(lambda y: normalise(y)[0]),
    ),
    headed(
        "rotation",
        "rotation-gradient-constant-norm",
        "the gradient divides by the norm as if it were a constant",
        quaternions(lambda y: normalise(y)[0], lambda bar, y: bar / normalise(y)[1]),
    ),
    known(
        "rotation",
        "rotation-positive-real",
        "the quaternion's sign is chosen so that its real part is positive",
        outputs={"r": lambda r: r * real_sign(r)},
        outputs_bar={"r": lambda bar, r: bar * real_sign(r)},
    ),
    known(
        "rotation",
        "rotation-component-major",
        "the outputs are read component by component instead of child by child",
        **component_major(4),
    ),
    known("rotation", "rotation-hac-order", HAC, **first_rows(hac_order)),
]


def scales(combine, activation=sigmoid):
    """A head (A, k, 3); combine(s_a, fraction) returns s, ds/ds_a and ds/dfraction of a child."""

    def head(y, given):
        shape = (len(y), y.shape[1] // 3, 3)
        fraction, slope = (a.reshape(shape) for a in activation(y))
        s, of_anchor, of_fraction = combine(given["s_a"][:, None, :], fraction)
        return {"s": s}, lambda bars: (
            (bars["s"] * of_fraction * slope).reshape(y.shape),
            {"s_a": (bars["s"] * of_anchor).sum(axis=1)},
        )

    return head


def times(s_a, fraction):
    return s_a * fraction, fraction, s_a


SCALE = [
    headed("scale", "scale-exp", "exp for sigmoid", scales(times, exponential)),
    headed("scale", "scale-tanh", "tanh for sigmoid", scales(times, tanh)),
    headed(
        "scale",
        "scale-added",
        "s_a is added to the sigmoid instead of multiplied",
        scales(lambda s_a, fraction: (s_a + fraction, np.ones_like(fraction), 1)),
    ),
    headed(
        "scale",
        "scale-log",
        "s_a is taken for a logarithm: exp(s_a) is multiplied",
        scales(lambda s_a, fraction: (np.exp(s_a) * fraction, np.exp(s_a) * fraction, np.exp(s_a))),
    ),
    headed(
        "scale",
        "scale-no-anchor",
        "the anchor's scale s_a is left out",
        scales(lambda s_a, fraction: (fraction, 0 * fraction, 1)),
    ),
    known(
        "scale",
        "scale-log-gradient",
        "the gradient of s_a is that of log s_a: it has one factor s_a too many",
        inputs_bar={"s_a": lambda bar, s_a: bar * s_a},
    ),
    known(
        "scale",
        "scale-axis-major",
        "the outputs are read axis by axis instead of child by child",
        **component_major(3),
    ),
    known("scale", "scale-hac-order", HAC, **first_rows(hac_order)),
]


# --- the networks themselves --------------------------------------------------------------------
def perceptron(hidden, last=identity):
    """A network with other activations, `hidden` between layers and `last` behind the last one."""

    def run(given, cotangents):
        weights, biases = given["weights"], given["biases"]
        inputs, slopes = [given["x"]], []
        for i, (W, b) in enumerate(zip(weights, biases)):
            value, slope = (hidden if i + 1 < len(weights) else last)(inputs[-1] @ W + b)
            inputs.append(value)
            slopes.append(slope)
        bar, weights_bar, biases_bar = bars_of(cotangents)["y"], [], []
        for W, x, slope in zip(reversed(weights), reversed(inputs[:-1]), reversed(slopes)):
            bar = bar * slope
            weights_bar.insert(0, x.T @ bar)
            biases_bar.insert(0, bar.sum(axis=0))
            bar = bar @ W.T
        return {"y": inputs[-1]}, {"x": bar, "weights": weights_bar, "biases": biases_bar}

    return run


def leaky(y):
    return np.where(y > 0, y, y.dtype.type(0.01) * y), np.where(y > 0, 1, 0.01).astype(y.dtype)


def per_row(bars, given):
    rows = np.float64(len(given["x"])).astype(given["x"].dtype)
    return {**bars, **{name: [bar / rows for bar in bars[name]] for name in ("weights", "biases")}}


MLP = [
    surgery("mlp", "mlp-no-relu", "no ReLU between the layers", perceptron(identity)),
    surgery("mlp", "mlp-last-relu", "a ReLU follows the last layer too", perceptron(relu, relu)),
    surgery("mlp", "mlp-leaky-relu", "leaky ReLU with slope 0.01 for ReLU", perceptron(leaky)),
    surgery(
        "mlp",
        "mlp-relu-gradient",
        "the ReLU lets every gradient through",
        perceptron(lambda y: (relu(y)[0], np.ones_like(y))),
    ),
    surgery(
        "mlp",
        "mlp-kink",
        "at the ReLU's kink the gradient is 1 instead of 0",
        perceptron(lambda y: (relu(y)[0], (y >= 0).astype(y.dtype))),
    ),
    known(
        "mlp",
        "mlp-no-bias",
        "the biases are left out",
        inputs={"biases": lambda biases: [0 * b for b in biases]},
        inputs_bar={"biases": lambda bars, _: [0 * bar for bar in bars]},
    ),
    known(
        "mlp",
        "mlp-column-major",
        "the weights are read column by column instead of row by row",
        inputs={"weights": lambda weights: [W.reshape(W.shape[::-1]).T for W in weights]},
        inputs_bar={"weights": lambda bars, _: [bar.T.reshape(bar.shape) for bar in bars]},
    ),
    known(
        "mlp",
        "mlp-mean-gradient",
        "gradients of weights and biases are means over the rows instead of sums",
        inputs_bar=per_row,
    ),
]

MISTAKES = [*OFFSETS, *VIEW, *OPACITY, *MASKING, *COLOR, *ROTATION, *SCALE, *MLP]
