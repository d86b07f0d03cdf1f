"""Known mistakes in Eqs. (1) to (4), masking and the networks."""

import numpy as np

from tests.workshop.mistakes.kit import (
    component_major,
    edited,
    first_rows,
    hac_order,
    known,
    layer_transposed,
    no_gradient,
    squares_transposed,
    without,
)

HAC = "the networks' input is (f_a, d_vc, delta_vc), HAC's order, instead of (f_a, delta_vc, d_vc)"

# Text of the equations that several mistakes replace.
KEPT = "mask & (alpha >= tau_alpha)"
FRACTION = "s_a[:, None, :] * sigmoid(psi_s)"
ANCHOR_BAR = "(s_bar * sigmoid(psi_s)).sum"
PSI_BAR = "s_bar * s_a[:, None, :] * sigmoid_slope(psi_s)"
READ = {"full_bar[index] = kept_bar": "full_bar[index[: len(kept_bar)]] = kept_bar[: len(index)]"}


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
        "offsets-subtracted",
        "the offsets are subtracted: x_a - O_a l_a",
        inputs={"l_a": np.negative},
        inputs_bar={"l_a": lambda bar, _: -bar},
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
    edited(
        "offsets",
        "offsets-last-child",
        "the gradient of x_a is that of the last child alone instead of the sum over the children",
        {'"x_a": x_bar.sum(axis=1)': '"x_a": x_bar[:, -1]'},
    ),
    known(
        "offsets",
        "offsets-log-gradient",
        "the gradient of l_a is that of log l_a: it has one factor l_a too many",
        inputs_bar={"l_a": lambda bar, l_a: bar * l_a},
    ),
]


# --- Eq. (2) ------------------------------------------------------------------------------------


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
    edited(
        "view",
        "view-epsilon",
        "d_vc is divided by delta_vc + 1e-6 instead of delta_vc",
        {
            "return (delta_vc, d_vc), (": "return (delta_vc, v / (delta_vc + 1e-6)), (",
            "perpendicular(d_vc, d_vc_bar) / nonzero(delta_vc)": (
                "(perpendicular(d_vc, d_vc_bar * (delta_vc > 0)) "
                "+ d_vc * (d_vc * d_vc_bar).sum(axis=1, keepdims=True) * 1e-6 / (delta_vc + 1e-6)) "
                "/ (delta_vc + 1e-6)"
            ),
        },
    ),
    *(
        edited(
            "view",
            f"view-epsilon-{epsilon}-in-the-root",
            f"{epsilon} stands inside the root of delta_vc, which also divides",
            {
                "delta_vc = length(v)": f"delta_vc = np.sqrt(length(v) ** 2 + {epsilon})",
                "perpendicular(d_vc, d_vc_bar)": (
                    "(d_vc_bar - d_vc * (d_vc * d_vc_bar).sum(axis=1, keepdims=True))"
                ),
            },
        )
        for epsilon in ("1e-6", "1e-8", "1e-12")
    ),
    edited(
        "view",
        "view-radial-gradient",
        "the gradient of d_vc treats the length in its denominator as a constant",
        {"perpendicular(d_vc, d_vc_bar)": "d_vc_bar * (delta_vc > 0)"},
    ),
]


# --- Eq. (3) ------------------------------------------------------------------------------------
def view_first(given):
    d = given["f_a"].shape[1]
    return np.array([*range(d, len(given["weights"][0])), *range(d)])


OPACITY = [
    edited(
        "opacity",
        "opacity-sigmoid",
        "sigmoid for tanh",
        {
            "np.tanh(psi_alpha[:, :, 0])": "1 / (1 + np.exp(-psi_alpha[:, :, 0]))",
            "tanh_slope(psi_alpha)": "1 / (2 + np.exp(psi_alpha) + np.exp(-psi_alpha))",
        },
    ),
    edited(
        "opacity",
        "opacity-linear",
        "no activation: the tanh is missing",
        {"np.tanh(psi_alpha[:, :, 0])": "psi_alpha[:, :, 0]", "tanh_slope(psi_alpha)": "1"},
    ),
    edited(
        "opacity",
        "opacity-positive",
        "negative opacities are set to zero",
        {
            "np.tanh(psi_alpha[:, :, 0])": "np.maximum(np.tanh(psi_alpha[:, :, 0]), 0)",
            "tanh_slope(psi_alpha)": "(tanh_slope(psi_alpha) * (psi_alpha > 0))",
        },
    ),
    edited(
        "opacity",
        "opacity-slope",
        "the slope of tanh is taken as 1 - alpha instead of 1 - alpha^2",
        {"tanh_slope(psi_alpha)": "(1 - np.tanh(psi_alpha))"},
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


def child_major(tree, *_):
    return {name: a.swapaxes(0, 1) if np.ndim(a) > 1 else a for name, a in tree.items()}


MASKING = [
    edited(
        "masking",
        "masking-strict",
        "alpha > tau_alpha instead of alpha >= tau_alpha",
        {KEPT: "mask & (alpha > tau_alpha)", **READ},
    ),
    edited(
        "masking",
        "masking-mask-ignored",
        "children masked for good are drawn: the mask is ignored",
        {KEPT: "alpha >= tau_alpha", **READ},
    ),
    edited(
        "masking",
        "masking-threshold-ignored",
        "everything not masked is kept: tau_alpha is ignored",
        {KEPT: "mask", **READ},
    ),
    edited(
        "masking",
        "masking-multiplied",
        "alpha is multiplied by the mask; at tau_alpha = 0 a masked child is kept, with opacity 0",
        {
            f"index = np.flatnonzero({KEPT})": (
                "alpha = alpha * mask\n    index = np.flatnonzero(alpha >= tau_alpha)"
            ),
            "return (alpha.reshape(-1)[index], *kept, index), (index, alpha.shape)": (
                "return (alpha.reshape(-1)[index], *kept, index), (index, alpha.shape, mask)"
            ),
            "scatter(saved, alpha_bar)": "scatter(saved, alpha_bar) * saved[2]",
            "index, (A, k) = saved": "index, (A, k), _ = saved",
            **READ,
        },
    ),
    known(
        "masking",
        "masking-child-major",
        "the list runs child by child over all anchors instead of anchor by anchor",
        inputs=child_major,
        inputs_bar=child_major,
    ),
    edited(
        "masking",
        "masking-gradient-packed",
        "gradients are not scattered back: they stay in the first rows",
        {"full_bar[index] = kept_bar": "full_bar[: len(index)] = kept_bar"},
    ),
]


# --- Eq. (3) for colour and rotation, Eq. (4) ---------------------------------------------------


def eight_bits(out, _):
    return {"color": np.rint(out["color"] * 255) / 255}


COLOR = [
    edited(
        "color",
        "color-tanh",
        "tanh for sigmoid",
        {
            "return sigmoid(psi_c)": "return np.tanh(psi_c)",
            "sigmoid_slope(psi_c)": "4 * sigmoid_slope(2 * psi_c)",
        },
    ),
    edited(
        "color",
        "color-linear",
        "no activation: the sigmoid is missing",
        {"return sigmoid(psi_c)": "return psi_c", "sigmoid_slope(psi_c)": "1"},
    ),
    edited(
        "color",
        "color-slope",
        "the slope of the sigmoid lacks its factor 1 - color",
        {"sigmoid_slope(psi_c)": "sigmoid(psi_c)"},
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
    edited(
        "rotation",
        "rotation-not-normalised",
        "the quaternion is not normalised",
        {
            "r, norm = normalise(psi_r)": "r, norm = psi_r, None",
            "normalise_backward(r, norm, r_bar)": "r_bar",
        },
    ),
    edited(
        "rotation",
        "rotation-gradient-not-normalised",
        "the normalisation is missing in backward alone",
        {"normalise_backward(r, norm, r_bar)": "r_bar"},
    ),
    edited(
        "rotation",
        "rotation-gradient-constant-norm",
        "the gradient divides by the norm as if it were a constant",
        {"normalise_backward(r, norm, r_bar)": "r_bar / norm"},
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


SCALE = [
    edited(
        "scale",
        "scale-exp",
        "exp for sigmoid",
        {
            FRACTION: "s_a[:, None, :] * np.exp(psi_s)",
            ANCHOR_BAR: "(s_bar * np.exp(psi_s)).sum",
            PSI_BAR: "s_bar * s_a[:, None, :] * np.exp(psi_s)",
        },
    ),
    edited(
        "scale",
        "scale-tanh",
        "tanh for sigmoid",
        {
            FRACTION: "s_a[:, None, :] * np.tanh(psi_s)",
            ANCHOR_BAR: "(s_bar * np.tanh(psi_s)).sum",
            PSI_BAR: "s_bar * s_a[:, None, :] * 4 * sigmoid_slope(2 * psi_s)",
        },
    ),
    edited(
        "scale",
        "scale-added",
        "s_a is added to the sigmoid instead of multiplied",
        {
            FRACTION: "s_a[:, None, :] + sigmoid(psi_s)",
            ANCHOR_BAR: "s_bar.sum",
            PSI_BAR: "s_bar * sigmoid_slope(psi_s)",
        },
    ),
    edited(
        "scale",
        "scale-log",
        "s_a is taken for a logarithm: exp(s_a) is multiplied",
        {
            FRACTION: "np.exp(s_a)[:, None, :] * sigmoid(psi_s)",
            ANCHOR_BAR: "(s_bar * np.exp(s_a)[:, None, :] * sigmoid(psi_s)).sum",
            PSI_BAR: "s_bar * np.exp(s_a)[:, None, :] * sigmoid_slope(psi_s)",
        },
    ),
    edited(
        "scale",
        "scale-no-anchor",
        "the anchor's scale s_a is left out",
        {
            FRACTION: "sigmoid(psi_s)",
            ANCHOR_BAR: "(0 * s_bar).sum",
            PSI_BAR: "s_bar * sigmoid_slope(psi_s)",
        },
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


def per_row(bars, given):
    rows = np.float64(len(given["x"])).astype(given["x"].dtype)
    return {**bars, **{name: [bar / rows for bar in bars[name]] for name in ("weights", "biases")}}


MLP = [
    edited(
        "mlp",
        "mlp-no-relu",
        "no ReLU between the layers",
        {"np.maximum(hidden, 0, out=hidden)": "hidden", "(inputs[i] > 0)": "np.ones_like(y_bar)"},
    ),
    edited(
        "mlp",
        "mlp-last-relu",
        "a ReLU follows the last layer too",
        {
            "return y, (inputs, weights)": "return np.maximum(y, 0), (inputs, weights, y > 0)",
            "inputs, weights = saved": "inputs, weights, y_bar = *saved[:2], y_bar * saved[2]",
        },
    ),
    edited(
        "mlp",
        "mlp-leaky-relu",
        "leaky ReLU with slope 0.01 for ReLU",
        {
            "np.maximum(hidden, 0, out=hidden)": (
                "np.where(hidden > 0, hidden, hidden.dtype.type(0.01) * hidden)"
            ),
            "(inputs[i] > 0)": "np.where(inputs[i] > 0, 1, 0.01)",
        },
    ),
    edited(
        "mlp",
        "mlp-relu-gradient",
        "the ReLU lets every gradient through",
        {"(inputs[i] > 0)": "np.ones_like(y_bar)"},
    ),
    edited(
        "mlp",
        "mlp-kink",
        "at the ReLU's kink the gradient is 1 instead of 0",
        {
            "inputs = [x]": "inputs, before = [x], [x]",
            "inputs.append(np.maximum(hidden, 0, out=hidden))": (
                "inputs, before = [*inputs, np.maximum(hidden, 0)], [*before, hidden]"
            ),
            "return y, (inputs, weights)": "return y, (inputs, weights, before)",
            "inputs, weights = saved": "inputs, weights, before = saved",
            "inputs[i] > 0": "before[i] >= 0",
        },
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
        "mlp-square-transposed",
        "square weights are transposed: as PyTorch stores them, or twice",
        inputs={"weights": squares_transposed},
        inputs_bar={"weights": squares_transposed},
    ),
    *(
        known(
            "mlp",
            f"mlp-{name}-transposed",
            f"the weight of the {name} layer is transposed: as PyTorch stores it, or twice",
            **layer_transposed(i),
        )
        for name, i in (("first", 0), ("second", 1))
    ),
    known(
        "mlp",
        "mlp-mean-gradient",
        "gradients of weights and biases are means over the rows instead of sums",
        inputs_bar=per_row,
    ),
]

MISTAKES = [*OFFSETS, *VIEW, *OPACITY, *MASKING, *COLOR, *ROTATION, *SCALE, *MLP]
