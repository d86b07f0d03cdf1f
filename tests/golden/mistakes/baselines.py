"""Known mistakes in the equations of the baselines: D1 to D3, H1 to H3 and G1 to G4."""

import numpy as np

from p4dgs_ref.equations import mlp
from tests.golden.mistakes.kit import (
    bars_of,
    edited,
    inverse,
    known,
    no_gradient,
    port,
    squares_transposed,
    surgery,
)
from tests.golden.mistakes.motion import exchanged, exchanged_bar

# --- D1 -----------------------------------------------------------------------------------------


ACTIVATIONS = [
    known(
        "activations",
        "activations-linear-scale",
        "s is log_s itself: the stored numbers are not logarithms there",
        outputs=lambda out, given: {**out, "s": given["log_s"]},
        inputs_bar={"log_s": lambda bar, log_s: bar / np.exp(log_s)},
    ),
    known(
        "activations",
        "activations-variance",
        "log_s is taken for the logarithm of a variance: s = exp(log_s / 2)",
        inputs={"log_s": lambda log_s: log_s / 2},
        inputs_bar={"log_s": lambda bar, _: bar / 2},
    ),
    edited(
        "activations",
        "activations-not-normalised",
        "the quaternion is not normalised",
        {
            "r, norm = normalise(raw_r)": "r, norm = raw_r, None",
            "normalise_backward(r, norm, r_bar)": "r_bar",
        },
    ),
    edited(
        "activations",
        "activations-gradient-not-normalised",
        "the gradient of the quaternion passes its normalisation unchanged",
        {"normalise_backward(r, norm, r_bar)": "r_bar"},
    ),
    edited(
        "activations",
        "activations-gradient-not-projected",
        "backward takes the length of the quaternion for a constant",
        {
            "(s, r, norm, logit_alpha)": (
                "(s, r, np.linalg.norm(raw_r, axis=1, keepdims=True), logit_alpha)"
            ),
            "normalise_backward(r, norm, r_bar)": "r_bar * (1 / norm)",
        },
    ),
    edited(
        "activations",
        "activations-tanh",
        "alpha is tanh of the logit",
        {
            "r, sigmoid(logit_alpha))": "r, np.tanh(logit_alpha))",
            "alpha_bar * sigmoid_slope(logit_alpha)": "alpha_bar * (1 - np.tanh(logit_alpha) ** 2)",
        },
    ),
    edited(
        "activations",
        "activations-gradient-no-sigmoid",
        "the gradient of the logit lacks the slope of the sigmoid",
        {"alpha_bar * sigmoid_slope(logit_alpha)": "alpha_bar"},
    ),
]


# --- D2 -----------------------------------------------------------------------------------------
NEGATIVE = (1, 3, 5, 7, 9, 11, 13, 15)  # the harmonics of odd order, which have the sign (-1)^m


def signed(sh):
    signs = np.ones(16, sh.dtype)
    signs[list(NEGATIVE)] = -1
    return sh * signs[: sh.shape[2]]


def coefficients(order):
    """The changes of a port that has coefficient order[k] where the vectors have k."""

    def index(K):
        return [*order, *range(len(order), K)] if K >= len(order) else range(K)

    return dict(
        inputs={"sh": lambda sh: sh[:, :, index(sh.shape[2])]},
        inputs_bar={"sh": lambda bar, sh: bar[:, :, inverse(index(sh.shape[2]))]},
    )


def coefficient_major(sh):
    """3 K numbers that are read as K coefficients of three colours."""
    N, _, K = sh.shape
    return np.swapaxes(sh.reshape(N, K, 3), 1, 2)


def unit_direction(given, cotangents):
    length = np.linalg.norm(given["d"], axis=1, keepdims=True)
    unit = given["d"] / length
    out, in_bar = port("sh_color")({**given, "d": unit}, cotangents)
    along = (in_bar["d"] * unit).sum(axis=1, keepdims=True)
    return out, {**in_bar, "d": (in_bar["d"] - unit * along) / length}


SH_COLOR = [
    edited(
        "sh_color",
        "sh-color-no-half",
        "1/2 is not added",
        {"raw = 0.5 + np.einsum": "raw = np.einsum"},
    ),
    edited(
        "sh_color",
        "sh-color-no-clamp",
        "the colour is not clamped at 0",
        {"np.maximum(raw, 0)": "raw", "color_bar * (raw >= 0)": "color_bar"},
    ),
    edited(
        "sh_color",
        "sh-color-clamp-gradient",
        "the gradient passes where the colour was clamped to 0",
        {"color_bar * (raw >= 0)": "color_bar"},
    ),
    known(
        "sh_color",
        "sh-color-signs",
        "the harmonics of odd order lack their minus: x, y instead of -x, -y",
        inputs={"sh": signed},
        inputs_bar={"sh": lambda bar, _: signed(bar)},
    ),
    known(
        "sh_color",
        "sh-color-xyz",
        "degree 1 has the order x, y, z instead of y, z, x",
        **coefficients((0, 2, 3, 1)),
    ),
    known(
        "sh_color",
        "sh-color-by-coefficient",
        "the 3 K numbers are read coefficient by coefficient, not colour by colour",
        inputs={"sh": coefficient_major},
        inputs_bar={"sh": lambda bar, sh: np.swapaxes(bar, 1, 2).reshape(sh.shape)},
    ),
    known(
        "sh_color",
        "sh-color-towards-the-camera",
        "d points from the Gaussian to the camera",
        inputs={"d": np.negative},
        inputs_bar={"d": lambda bar, _: -bar},
    ),
    surgery(
        "sh_color",
        "sh-color-normalised",
        "d is normalised once more; Eq. (2) has done that, and gives 0 in the camera",
        unit_direction,
    ),
    known(
        "sh_color",
        "sh-color-no-gradient-of-d",
        "the direction receives no gradient",
        inputs_bar={"d": no_gradient},
    ),
    edited(
        "sh_color",
        "sh-color-first-slope",
        "the gradient of coefficient 1 has C_0 instead of C_1, as in the kernel of 4DGS",
        {
            '"sh": raw_bar[:, :, None] * Y[:, None, :]': (
                '"sh": raw_bar[:, :, None] * Y[:, None, :] * np.where(np.arange(Y.shape[1]) '
                "== 1, C_0 / C_1, 1)"
            )
        },
    ),
]


# --- D3 -----------------------------------------------------------------------------------------


DEFORMATION_D3DGS = [
    edited(
        "deformation_d3dgs",
        "d3dgs-skip-order",
        "the layer of the skip sees (h, inputs) instead of (inputs, h)",
        {
            "np.concatenate([inputs, hidden], axis=1)": "np.concatenate([hidden, inputs], axis=1)",
            'inputs_bar = after["x"][:, :width]': 'inputs_bar = after["x"][:, -width:]',
            'after["x"][:, width:] * (hidden > 0)': 'after["x"][:, :-width] * (hidden > 0)',
        },
    ),
    edited(
        "deformation_d3dgs",
        "d3dgs-time-first",
        "the inputs are (psi_t(E(t)), E(x)) instead of (E(x), psi_t(E(t)))",
        {
            "np.concatenate([E_x, every_row], axis=1)": "np.concatenate([every_row, E_x], axis=1)",
            "inputs_bar[:, width_x:].sum(": "inputs_bar[:, :-width_x].sum(",
            "E_x_bar = inputs_bar[:, :width_x]": "E_x_bar = inputs_bar[:, -width_x:]",
        },
    ),
    edited(
        "deformation_d3dgs",
        "d3dgs-time-relu",
        "a ReLU follows the last layer of psi_t",
        {
            "np.broadcast_to(seen_time, (len": (
                "np.broadcast_to(np.maximum(seen_time, 0) if time_weights else seen_time, (len"
            ),
            "saved = saved_encoding, saved_time, saved_before,": (
                "saved = saved_encoding, saved_time and (saved_time, seen_time > 0), saved_before,"
            ),
            "mlp.backward(saved_time, seen_time_bar, needs_x=False)": (
                "mlp.backward(saved_time[0], seen_time_bar * saved_time[1], needs_x=False)"
            ),
        },
    ),
    edited(
        "deformation_d3dgs",
        "d3dgs-time-gradient-mean",
        "the gradient of psi_t is the mean over the Gaussians instead of the sum",
        {"inputs_bar[:, width_x:].sum(": "inputs_bar[:, width_x:].mean("},
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-heads-swapped",
        "the heads of position and scale are exchanged",
        outputs=exchanged,
        outputs_bar=exchanged_bar,
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-square-transposed",
        "square weights are transposed: as PyTorch stores them, or twice",
        inputs={"weights": squares_transposed},
        inputs_bar={"weights": squares_transposed},
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-no-gradient-of-x",
        "the gradient of x is stopped before E(x), as the pipeline does; the equation has it",
        inputs_bar={"x": no_gradient},
    ),
]


# --- H1 -----------------------------------------------------------------------------------------


def stored(forth, back):
    """The changes of a port that reads the numbers of a plane in another order."""
    return dict(
        inputs={"planes": lambda planes: [forth(P) for P in planes]},
        inputs_bar={"planes": lambda bars, planes: [back(b, P) for b, P in zip(bars, planes)]},
    )


PLANE_FEATURES = [
    edited(
        "plane_features",
        "planes-cell-centres",
        "nodes are in the middle of cells (align_corners off); they span the box from end to end",
        {
            "u[np.resize(AXES, nodes.shape)] * last.astype(u.dtype)": (
                "np.clip(u[np.resize(AXES, nodes.shape)] * (last + 1) - 0.5, 0, "
                "last).astype(u.dtype)"
            ),
            "(u > 0) & (u < 1), index": "u, index",
            "extent, inside, index": "extent, u, index",
            "u_bar[axis] += (n - 1) * position_bar[p]": (
                "u_bar[axis] += n * position_bar[p] * (u[axis] * n > 0.5) * (u[axis] * n < n - 0.5)"
            ),
            "(u_bar * inside)": "(u_bar * ((u > 0) & (u < 1)))",
        },
    ),
    edited(
        "plane_features",
        "planes-half-of-the-time",
        "t is read on the axis from -1 to 1, so that the first half of the nodes is never read",
        {"np.full((N, 1), t, x.dtype)": "np.full((N, 1), (t + 1) / 2, x.dtype)"},
    ),
    edited(
        "plane_features",
        "planes-order",
        "the planes are taken in the order xy, xz, xt, yz, yt, zt",
        {
            "AXES = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))": (
                "AXES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))"
            ),
        },
    ),
    edited(
        "plane_features",
        "planes-added",
        "the planes of a level are added instead of multiplied",
        {
            "values.prod(axis=1)]": "values.sum(axis=1)]",
            "np.stack(others, axis=1) * levels_bar[:, None]": (
                "np.ones_like(values) * levels_bar[:, None]"
            ),
        },
    ),
    edited(
        "plane_features",
        "planes-gradient-at-the-border",
        "a coordinate on or beyond a face keeps the slope of the last cell",
        {"(u_bar * inside)": "u_bar"},
    ),
    edited(
        "plane_features",
        "planes-gradient-by-division",
        "the gradient of a plane is the product divided by its own value, 0/0 where that is 0",
        {"np.stack(others, axis=1)": "values.prod(axis=1)[:, None] / values"},
    ),
    known(
        "plane_features",
        "planes-transposed",
        "a plane is read as [J, I, F]: the second axis first",
        **stored(
            lambda P: P.reshape(P.shape[1], P.shape[0], P.shape[2]).transpose(1, 0, 2),
            lambda bar, P: bar.transpose(1, 0, 2).reshape(P.shape),
        ),
    ),
    known(
        "plane_features",
        "planes-channels-first",
        "a plane is read as [F, J, I], as PyTorch stores it",
        **stored(
            lambda P: P.reshape(P.shape[::-1]).transpose(2, 1, 0),
            lambda bar, P: bar.transpose(2, 1, 0).reshape(P.shape),
        ),
    ),
    edited(
        "plane_features",
        "planes-gradient-not-scaled",
        "the gradient of x lacks the division by the extent of the box",
        {".T / extent,": ".T,"},
    ),
    known(
        "plane_features",
        "planes-no-gradient-of-x",
        "x is detached, as in D3DGS; 4DHexPlane lets its gradient through",
        inputs_bar={"x": no_gradient},
    ),
]


# --- H2 -----------------------------------------------------------------------------------------
DELTAS = ("delta_x", "delta_log_s", "delta_raw_r")


def linear_heads(given, cotangents):
    """Every head is one layer after the other, without the ReLU between them."""
    weights, biases, bars = given["weights"], given["biases"], bars_of(cotangents)
    y, saved = mlp.forward(given["features"], weights[:-6], biases[:-6])
    h, out, h_bar = np.maximum(y, 0), {}, 0
    weights_bar, biases_bar = [], []
    for name, i in zip(DELTAS, range(len(weights) - 6, len(weights), 2)):
        z = h @ weights[i] + biases[i]
        out[name] = z @ weights[i + 1] + biases[i + 1]
        z_bar = bars[name] @ weights[i + 1].T
        weights_bar += [h.T @ z_bar, z.T @ bars[name]]
        biases_bar += [z_bar.sum(axis=0), bars[name].sum(axis=0)]
        h_bar = h_bar + z_bar @ weights[i].T
    trunk = mlp.backward(saved, h_bar * (y > 0))
    weights_bar, biases_bar = trunk["weights"] + weights_bar, trunk["biases"] + biases_bar
    return out, {"features": trunk["x"], "weights": weights_bar, "biases": biases_bar}


PLANE_DECODER = [
    edited(
        "plane_decoder",
        "decoder-no-relu",
        "no ReLU follows phi: the heads see phi(features) itself",
        {"h = np.maximum(before, 0)": "h = before", "h_bar * (before > 0)": "h_bar"},
    ),
    surgery(
        "plane_decoder",
        "decoder-heads-linear",
        "the heads have no ReLU between their two layers",
        linear_heads,
    ),
    edited(
        "plane_decoder",
        "decoder-gradient-of-one-head",
        "h receives the gradient of the last head alone instead of the sum of all three",
        {'sum(head["x"] for head in heads)': 'heads[-1]["x"]'},
    ),
    known(
        "plane_decoder",
        "decoder-heads-swapped",
        "the heads of position and scale are exchanged",
        outputs=lambda out, _: swapped(out),
        outputs_bar=lambda bars, *_: swapped(bars),
    ),
]


def swapped(tree):
    return {**tree, "delta_x": tree["delta_log_s"], "delta_log_s": tree["delta_x"]}


# --- H3 -----------------------------------------------------------------------------------------


PLANE_LOSSES = [
    edited(
        "plane_losses",
        "plane-losses-sums",
        "the losses are sums over the nodes of a plane instead of means",
        {
            "(d * d).sum() / max(d.size, 1)": "(d * d).sum()",
            "slope *= 2 / max(slope.size, 1)": "slope *= 2",
            "np.abs(plane - 1).mean()": "np.abs(plane - 1).sum()",
            "np.sign(plane - 1) / plane.size": "np.sign(plane - 1)",
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-smooth-space",
        "L_space has second differences along the second axis alone, as the authors' code",
        {
            "roughness(plane, 1, axis=0) + roughness(plane, 1, axis=1)": (
                "roughness(plane, 2, axis=1)"
            ),
            "roughness_slope(plane, 1, axis=0) + roughness_slope(plane, 1, axis=1)": (
                "roughness_slope(plane, 2, axis=1)"
            ),
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-one-axis",
        "L_space has the differences along the second axis alone",
        {
            "roughness(plane, 1, axis=0) + roughness(plane, 1, axis=1)": (
                "roughness(plane, 1, axis=1)"
            ),
            "roughness_slope(plane, 1, axis=0) + roughness_slope(plane, 1, axis=1)": (
                "roughness_slope(plane, 1, axis=1)"
            ),
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-first-differences",
        "L_time has first differences instead of second ones",
        {
            "losses[1] += roughness(plane, 2, axis=1)": "losses[1] += roughness(plane, 1, axis=1)",
            "L_time_bar * roughness_slope(plane, 2, axis=1)": (
                "L_time_bar * roughness_slope(plane, 1, axis=1)"
            ),
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-axis-of-time",
        "L_time runs along the first axis, which is in space",
        {
            "losses[1] += roughness(plane, 2, axis=1)": "losses[1] += roughness(plane, 2, axis=0)",
            "L_time_bar * roughness_slope(plane, 2, axis=1)": (
                "L_time_bar * roughness_slope(plane, 2, axis=0)"
            ),
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-all-planes",
        "L_one takes the planes in space, too",
        {
            "losses[0] += roughness(plane, 1, axis=0) + roughness(plane, 1, axis=1)": (
                "losses[::2] += roughness(plane, 1, axis=0) + roughness(plane, 1, axis=1), "
                "np.abs(plane - 1).mean()"
            ),
            "L_space_bar * slope": (
                "L_space_bar * slope + L_one_bar * np.sign(plane - 1) / plane.size"
            ),
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-mean-of-planes",
        "the losses are means over the planes instead of sums",
        {
            "tuple(losses), planes": "tuple(losses * (2 / len(planes))), planes",
            '{"planes": planes_bar}': '{"planes": [bar * (2 / len(planes)) for bar in planes_bar]}',
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-squared",
        "L_one is the mean of (P - 1)^2",
        {
            "np.abs(plane - 1).mean()": "np.square(plane - 1).mean()",
            "np.sign(plane - 1)": "2 * (plane - 1)",
        },
    ),
    edited(
        "plane_losses",
        "plane-losses-gradient-one-sided",
        "the gradient of a difference reaches only the last of its nodes",
        {
            "-np.diff(slope, axis=axis, prepend=zero, append=zero)": (
                "np.insert(slope, 0, 0, axis=axis)"
            ),
        },
    ),
]


# --- G1 -----------------------------------------------------------------------------------------
def turned(order):
    """The rows and columns of R in another order."""

    def change(R):
        return R[:, order][:, :, order]

    return change


def axes_ordered(order):
    """The changes of a port whose axis i is our axis order[i]."""
    back = turned(inverse(order))
    return dict(outputs={"R": turned(order)}, outputs_bar={"R": lambda bar, _: back(bar)})


def long(given, cotangents):
    """R of quaternions of any length: |l| |r| times that of unit quaternions."""
    out, in_bar = port("rotation_4d")(given, cotangents)
    lengths = {name: np.linalg.norm(q, axis=1, keepdims=True) for name, q in given.items()}
    factor = lengths["raw_l"] * lengths["raw_r"]
    product = (out["R"] * cotangents["R_bar"]).sum(axis=(1, 2))[:, None] * factor
    return {"R": out["R"] * factor[:, :, None]}, {
        name: in_bar[name] * factor + product * q / lengths[name] ** 2 for name, q in given.items()
    }


def through_the_length(given, cotangents):
    """The gradients of unit quaternions, as if they were those that are stored."""
    out, in_bar = port("rotation_4d")(given, cotangents)
    lengths = {name: np.linalg.norm(q, axis=1, keepdims=True) for name, q in given.items()}
    product = (out["R"] * cotangents["R_bar"]).sum(axis=(1, 2))[:, None]
    return out, {
        name: in_bar[name] * lengths[name] + product * q / lengths[name]
        for name, q in given.items()
    }


CONJUGATE = np.array([1, -1, -1, -1])
ROTATION_4D = [
    known(
        "rotation_4d",
        "rotation-4d-exchanged",
        "l and r are exchanged",
        inputs=lambda given: {"raw_l": given["raw_r"], "raw_r": given["raw_l"]},
        inputs_bar=lambda bars, _: {"raw_l": bars["raw_r"], "raw_r": bars["raw_l"]},
    ),
    known(
        "rotation_4d",
        "rotation-4d-not-conjugated",
        "r is not conjugated: R v = l v r",
        inputs={"raw_r": lambda r: r * CONJUGATE.astype(r.dtype)},
        inputs_bar={"raw_r": lambda bar, r: bar * CONJUGATE.astype(r.dtype)},
    ),
    known(
        "rotation_4d",
        "rotation-4d-time-first",
        "the axes are t, x, y, z instead of x, y, z, t",
        **axes_ordered([3, 0, 1, 2]),
    ),
    known(
        "rotation_4d",
        "rotation-4d-reversed",
        "the axes are t, z, y, x instead of x, y, z, t",
        **axes_ordered([3, 2, 1, 0]),
    ),
    known(
        "rotation_4d",
        "rotation-4d-transposed",
        "R is transposed: it acts on rows",
        outputs={"R": lambda R: np.swapaxes(R, 1, 2)},
        outputs_bar={"R": lambda bar, _: np.swapaxes(bar, 1, 2)},
    ),
    known(
        "rotation_4d",
        "rotation-4d-xyzw",
        "the quaternions are read as (x, y, z, w)",
        inputs=lambda given: {name: np.roll(q, 1, axis=1) for name, q in given.items()},
        inputs_bar=lambda bars, _: {name: np.roll(q, -1, axis=1) for name, q in bars.items()},
    ),
    surgery(
        "rotation_4d",
        "rotation-4d-not-normalised",
        "the quaternions are not normalised",
        long,
    ),
    surgery(
        "rotation_4d",
        "rotation-4d-gradient-not-normalised",
        "the gradients pass the normalisation of the quaternions unchanged",
        through_the_length,
    ),
]


# --- G2 -----------------------------------------------------------------------------------------
def schur(shape=1, velocity=1):
    """`run` with Sigma_t = A - b b^T / var_t**shape and x_t = x + b (t - mu_t) / var_t**velocity.

    An output that keeps its power 1, and what it gives to the gradients, is that of the right
    function.
    """

    def run(given, cotangents):
        bars = dict(cotangents)
        since = (given["t"] - given["mu_t"])[:, None]
        M = given["R"] * given["s"][:, None, :]
        Sigma = M @ np.swapaxes(M, 1, 2)
        b, var = Sigma[:, :3, 3], Sigma[:, 3, 3]
        Sigma_bar, mu_t_bar, changed = np.zeros_like(Sigma), 0, {}
        if shape != 1:
            G = bars.pop("Sigma_t_bar")
            factor = var**-shape
            changed["Sigma_t"] = (
                Sigma[:, :3, :3] - factor[:, None, None] * b[:, :, None] * b[:, None]
            )
            Sigma_bar[:, :3, :3] += G
            Sigma_bar[:, :3, 3] -= factor[:, None] * times(G + np.swapaxes(G, 1, 2), b)
            Sigma_bar[:, 3, 3] += shape * factor / var * (b * times(G, b)).sum(axis=1)
        if velocity != 1:
            bar, factor = bars.pop("x_t_bar"), var[:, None] ** -velocity
            changed["x_t"] = given["x"] + b * factor * since
            Sigma_bar[:, :3, 3] += bar * factor * since
            along = (bar * b * factor).sum(axis=1)
            Sigma_bar[:, 3, 3] -= velocity * along * since[:, 0] / var
            mu_t_bar = -along
        none = {name: np.zeros_like(bar) for name, bar in cotangents.items()}
        out, in_bar = port("conditional")(given, {**none, **bars})
        M_bar = (Sigma_bar + np.swapaxes(Sigma_bar, 1, 2)) @ M
        return {**out, **changed}, {
            "x": cotangents["x_t_bar"],
            "mu_t": in_bar["mu_t"] + mu_t_bar,
            "s": in_bar["s"] + (M_bar * given["R"]).sum(axis=1),
            "R": in_bar["R"] + M_bar * given["s"][:, None, :],
        }

    return run


def times(matrices, vectors):
    return (matrices @ vectors[:, :, None])[:, :, 0]


CONDITIONAL = [
    known(
        "conditional",
        "conditional-not-squared",
        "the scales are not squared: Sigma = R diag(s) R^T",
        inputs={"s": np.sqrt},
        inputs_bar={"s": lambda bar, s: bar / (2 * np.sqrt(s))},
    ),
    known(
        "conditional",
        "conditional-transposed",
        "R is transposed: Sigma = R^T diag(s)^2 R",
        inputs={"R": lambda R: np.swapaxes(R, 1, 2)},
        inputs_bar={"R": lambda bar, _: np.swapaxes(bar, 1, 2)},
    ),
    known(
        "conditional",
        "conditional-time-first",
        "the first axis of R is taken for time instead of the last",
        inputs={"R": lambda R: R[:, [1, 2, 3, 0]]},
        inputs_bar={"R": lambda bar, _: bar[:, [3, 0, 1, 2]]},
    ),
    known(
        "conditional",
        "conditional-backwards",
        "x_t has the wrong sign of the time: x - b (t - mu_t) / var_t",
        outputs=lambda out, given: {**out, "x_t": 2 * given["x"] - out["x_t"]},
        outputs_bar={"x_t": lambda bar, _: -bar},
        inputs_bar={"x": lambda bar, _: -bar},
    ),
    edited(
        "conditional",
        "conditional-marginal-shape",
        "Sigma_t is the block A itself: b b^T / var_t is not subtracted",
        {
            "Y @ Y.transpose(0, 2, 1), duration": (
                "M[:, :3] @ M[:, :3].transpose(0, 2, 1), duration"
            ),
            "(Sigma_t_bar + Sigma_t_bar.transpose(0, 2, 1)) @ Y": (
                "(Sigma_t_bar + Sigma_t_bar.transpose(0, 2, 1)) @ (R * s[:, None, :])[:, :3]"
            ),
            "velocity, M_bar[:, :3])": "velocity, dot_bar[:, :, None] * unit[:, None, :])",
        },
    ),
    surgery(
        "conditional",
        "conditional-shape-divided-twice",
        "b b^T is divided by var_t twice",
        schur(shape=2),
    ),
    surgery(
        "conditional",
        "conditional-velocity-not-divided",
        "the velocity is b: it is not divided by var_t",
        schur(velocity=0),
    ),
    surgery(
        "conditional",
        "conditional-velocity-divided-twice",
        "the velocity is divided by var_t twice",
        schur(velocity=2),
    ),
    edited(
        "conditional",
        "conditional-velocity-detached",
        "no gradient flows from x_t into s and R",
        {"dot_bar = x_t_bar * (since[:, None] / duration)": "dot_bar = 0 * x_t_bar"},
    ),
]


# --- G3 -----------------------------------------------------------------------------------------


def cut(limit):
    """Weights up to a limit count as 0."""

    def kept(tree, out):
        return {name: a * (out["weight"] > limit) for name, a in tree.items()}

    return dict(
        outputs=lambda out, _: kept(out, out),
        outputs_bar=lambda bars, out, _: kept(bars, out),
    )


MARGINAL = [
    known(
        "marginal",
        "marginal-no-half",
        "the exponent lacks the factor 1/2",
        inputs={"var_t": lambda var_t: var_t / 2},
        inputs_bar={"var_t": lambda bar, _: bar / 2},
    ),
    known(
        "marginal",
        "marginal-deviation",
        "var_t is taken for a standard deviation and squared",
        inputs={"var_t": np.square},
        inputs_bar={"var_t": lambda bar, var_t: 2 * var_t * bar},
    ),
    known(
        "marginal",
        "marginal-not-squared",
        "the exponent is divided by the standard deviation instead of the variance",
        inputs={"var_t": np.sqrt},
        inputs_bar={"var_t": lambda bar, var_t: bar / (2 * np.sqrt(var_t))},
    ),
    edited(
        "marginal",
        "marginal-normalised",
        "the density is normalised: it is divided by sqrt(2 pi var_t)",
        {
            "np.exp(-0.5 * since * (since / var_t))": (
                "np.exp(-0.5 * since * (since / var_t)) / np.sqrt(2 * np.pi * var_t)"
            ),
            "(alpha, weight, since / var_t)": "((alpha, var_t), weight, since / var_t)",
            "alpha, weight, u = saved": "(alpha, var_t), weight, u = saved",
            "0.5 * slope * u": (
                "0.5 * slope * u - (alpha_t_bar * alpha + weight_bar) * weight / (2 * var_t)"
            ),
        },
    ),
    known(
        "marginal",
        "marginal-cut",
        "weights up to 0.05 count as 0; the renderer leaves such Gaussians out, not the equation",
        **cut(0.05),
    ),
    known(
        "marginal",
        "marginal-smaller-cut",
        "weights up to 0.02 count as 0",
        **cut(0.02),
    ),
    known(
        "marginal",
        "marginal-gradient-sign",
        "the gradient of mu_t has the sign of that of t",
        inputs_bar={"mu_t": lambda bar, _: -bar},
    ),
]


# --- G4 -----------------------------------------------------------------------------------------


def waves_last(sh):
    N, _, T, K = sh.shape
    return np.swapaxes(sh.reshape(N, 3, K, T), 2, 3)


SPHERINDRICAL = [
    edited(
        "spherindrical",
        "spherindrical-no-two-pi",
        "the phase lacks 2 pi: cos(n (t - mu_t))",
        {
            "2 * np.pi * np.arange(sh.shape[2], dtype=sh.dtype)": (
                "np.arange(sh.shape[2], dtype=sh.dtype)"
            ),
        },
    ),
    edited(
        "spherindrical",
        "spherindrical-half-period",
        "the phase has pi instead of 2 pi",
        {
            "2 * np.pi * np.arange(sh.shape[2], dtype=sh.dtype)": (
                "np.pi * np.arange(sh.shape[2], dtype=sh.dtype)"
            ),
        },
    ),
    edited(
        "spherindrical",
        "spherindrical-from-one",
        "the waves count from 1: the coefficients that stand still get a wave",
        {
            "2 * np.pi * np.arange(sh.shape[2], dtype=sh.dtype)": (
                "2 * np.pi * np.arange(1, sh.shape[2] + 1, dtype=sh.dtype)"
            ),
        },
    ),
    edited(
        "spherindrical",
        "spherindrical-sines",
        "the waves are sines",
        {
            "waves = np.cos(phase)": "waves = np.sin(phase)",
            "slopes = frequency * np.sin(phase)": "slopes = -frequency * np.cos(phase)",
        },
    ),
    known(
        "spherindrical",
        "spherindrical-waves-last",
        "the coefficients are read as [K, T]: all waves of a harmonic side by side",
        inputs={"sh": waves_last},
        inputs_bar={"sh": lambda bar, sh: np.swapaxes(bar, 2, 3).reshape(sh.shape)},
    ),
    known(
        "spherindrical",
        "spherindrical-gradient-sign",
        "the gradient of mu_t has the sign of that of t",
        inputs_bar={"mu_t": lambda bar, _: -bar},
    ),
    edited(
        "spherindrical",
        "spherindrical-kernel-gradient",
        "along time only the highest wave has a slope, of the wrong sign, as in the kernel of 4DGS",
        {
            "slopes = frequency * np.sin(phase)": (
                "slopes = -frequency * np.sin(phase) * (frequency == frequency[-1])"
            ),
        },
    ),
]

MISTAKES = [
    *ACTIVATIONS,
    *SH_COLOR,
    *DEFORMATION_D3DGS,
    *PLANE_FEATURES,
    *PLANE_DECODER,
    *PLANE_LOSSES,
    *ROTATION_4D,
    *CONDITIONAL,
    *MARGINAL,
    *SPHERINDRICAL,
]
