"""Known mistakes in the equations of the baselines: D1 to D3, H1 to H3 and G1 to G4."""

import numpy as np

from p4dgs_ref.equations import mlp
from p4dgs_ref.equations.deformation_d3dgs import skip_layer
from p4dgs_ref.lab.baselines.plane_features import AXES
from tests.golden.mistakes.kit import (
    NotApplicable,
    bars_of,
    inverse,
    known,
    no_gradient,
    port,
    surgery,
)
from tests.golden.mistakes.motion import exchanged, exchanged_bar


# --- D1 -----------------------------------------------------------------------------------------
def unnormalised(given, cotangents):
    out, in_bar = port("activations")(given, cotangents)
    return {**out, "r": given["raw_r"]}, {**in_bar, "raw_r": cotangents["r_bar"]}


def turned_back(along_the_length):
    """`run` with the right r, whose gradient is r_bar times along_the_length(raw_r)."""

    def run(given, cotangents):
        out, in_bar = port("activations")(given, cotangents)
        factor = along_the_length(given["raw_r"])
        return out, {**in_bar, "raw_r": cotangents["r_bar"] * factor}

    return run


def slope_missing(given, cotangents):
    out, in_bar = port("activations")(given, cotangents)
    return out, {**in_bar, "logit_alpha": cotangents["alpha_bar"]}


def as_tanh(given, cotangents):
    out, in_bar = port("activations")(given, cotangents)
    alpha = np.tanh(given["logit_alpha"])
    return {**out, "alpha": alpha}, {
        **in_bar,
        "logit_alpha": cotangents["alpha_bar"] * (1 - alpha**2),
    }


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
    surgery(
        "activations",
        "activations-not-normalised",
        "the quaternion is not normalised",
        unnormalised,
    ),
    surgery(
        "activations",
        "activations-gradient-not-normalised",
        "the gradient of the quaternion passes its normalisation unchanged",
        turned_back(lambda raw_r: 1),
    ),
    surgery(
        "activations",
        "activations-gradient-not-projected",
        "backward takes the length of the quaternion for a constant",
        turned_back(lambda raw_r: 1 / np.linalg.norm(raw_r, axis=1, keepdims=True)),
    ),
    surgery("activations", "activations-tanh", "alpha is tanh of the logit", as_tanh),
    surgery(
        "activations",
        "activations-gradient-no-sigmoid",
        "the gradient of the logit lacks the slope of the sigmoid",
        slope_missing,
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


def raised(by):
    """The first coefficient that raises the colour by so much."""

    def change(sh):
        first = np.zeros_like(sh)
        first[:, :, 0] = by * 2 * np.sqrt(np.pi)
        return sh + first

    return change


def unclamped(shown):
    """`run` with no clamp in backward; in forward neither where `shown`."""

    def run(given, cotangents):
        # What the clamp cuts off is the colour of the opposite coefficients.
        opposite = {**given, "sh": raised(-1)(-given["sh"])}
        out, in_bar = port("sh_color")(given, cotangents)
        below, _ = port("sh_color")(opposite, cotangents)
        bar = -cotangents["color_bar"] * (below["color"] > 0)
        _, below_bar = port("sh_color")(opposite, {"color_bar": bar})
        color = out["color"] - below["color"] if shown else out["color"]
        return {"color": color}, {
            "d": in_bar["d"] + below_bar["d"],
            "sh": in_bar["sh"] - below_bar["sh"],
        }

    return run


def unit_direction(given, cotangents):
    length = np.linalg.norm(given["d"], axis=1, keepdims=True)
    unit = given["d"] / length
    out, in_bar = port("sh_color")({**given, "d": unit}, cotangents)
    along = (in_bar["d"] * unit).sum(axis=1, keepdims=True)
    return out, {**in_bar, "d": (in_bar["d"] - unit * along) / length}


def first_slope(bar, sh):
    factor = np.ones(sh.shape[2], sh.dtype)
    factor[1:2] = np.sqrt(1 / 3)  # C_0 / C_1
    return bar * factor


SH_COLOR = [
    known(
        "sh_color",
        "sh-color-no-half",
        "1/2 is not added",
        inputs={"sh": raised(-0.5)},
    ),
    surgery(
        "sh_color",
        "sh-color-no-clamp",
        "the colour is not clamped at 0",
        unclamped(shown=True),
    ),
    surgery(
        "sh_color",
        "sh-color-clamp-gradient",
        "the gradient passes where the colour was clamped to 0",
        unclamped(shown=False),
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
    known(
        "sh_color",
        "sh-color-first-slope",
        "the gradient of coefficient 1 has C_0 instead of C_1, as in the kernel of 4DGS",
        inputs_bar={"sh": first_slope},
    ),
]


# --- D3 -----------------------------------------------------------------------------------------
def layer_changed(tree, layer, change):
    weights = list(tree["weights"])
    weights[layer] = change(weights[layer])
    return {**tree, "weights": weights}


def skip_of(given):
    skip = skip_layer(given["weights"])
    if not skip:
        raise NotApplicable
    return skip, given["weights"][skip - 1].shape[1]  # the layer, and the columns before it


def hidden_first(given):
    """The rows of the skip's layer for a port that feeds it (h, inputs)."""
    skip, width = skip_of(given)
    return layer_changed(given, skip, lambda W: np.roll(W, -width, axis=0))


def hidden_first_bar(bars, given):
    skip, width = skip_of(given)
    return layer_changed(bars, skip, lambda W: np.roll(W, width, axis=0))


def time_first(tree, given, back=False):
    """The rows of both layers that see the inputs, for a port that has the time before E(x)."""
    width = 3 * (1 + 2 * given["L_x"])
    columns = len(given["weights"][0])
    order = np.concatenate([np.arange(columns - width, columns), np.arange(columns - width)])
    order = inverse(order) if back else order

    def rows(W):
        return np.concatenate([W[:columns][order], W[columns:]])

    found = layer_changed(tree, 0, rows)
    skip = skip_layer(given["weights"])
    return layer_changed(found, skip, rows) if skip else found


def with_last_relu(given):
    if not given["time_weights"]:
        raise NotApplicable
    n = given["time_weights"][-1].shape[1]
    dtype = given["x"].dtype
    return {
        **given,
        "time_weights": [*given["time_weights"], np.eye(n, dtype=dtype)],
        "time_biases": [*given["time_biases"], np.zeros(n, dtype)],
    }


def mean_over_rows(bars, given):
    if not given["time_weights"]:
        raise NotApplicable
    names = ("time_weights", "time_biases")
    return {**bars, **{name: [a / len(given["x"]) for a in bars[name]] for name in names}}


DEFORMATION_D3DGS = [
    known(
        "deformation_d3dgs",
        "d3dgs-skip-order",
        "the layer of the skip sees (h, inputs) instead of (inputs, h)",
        inputs=hidden_first,
        inputs_bar=hidden_first_bar,
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-time-first",
        "the inputs are (psi_t(E(t)), E(x)) instead of (E(x), psi_t(E(t)))",
        inputs=lambda given: time_first(given, given),
        inputs_bar=lambda bars, given: time_first(bars, given, back=True),
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-time-relu",
        "a ReLU follows the last layer of psi_t",
        inputs=with_last_relu,
        inputs_bar=lambda bars, given: {
            **bars,
            "time_weights": bars["time_weights"][:-1],
            "time_biases": bars["time_biases"][:-1],
        },
    ),
    known(
        "deformation_d3dgs",
        "d3dgs-time-gradient-mean",
        "the gradient of psi_t is the mean over the Gaussians instead of the sum",
        inputs_bar=mean_over_rows,
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
        "d3dgs-no-gradient-of-x",
        "the gradient of x is stopped before E(x), as the pipeline does; the equation has it",
        inputs_bar={"x": no_gradient},
    ),
]


# --- H1 -----------------------------------------------------------------------------------------
def on_nodes(u, n):
    """Nodes 0 and n - 1 at the two ends, as with align_corners."""
    return u * (n - 1), float(n - 1)


def on_cells(u, n):
    """Every node in the middle of a cell, as without align_corners."""
    return np.clip(u * n - 0.5, 0, n - 1), n * ((u * n > 0.5) & (u * n < n - 0.5))


def hexplane(position=on_nodes, axes=AXES, time=lambda t: t, inside=True, divided=False, add=False):
    """`run` of the features with some steps changed."""

    def run(given, cotangents):
        x, lo, hi, planes = (given[name] for name in ("x", "lo", "hi", "planes"))
        extent = np.where(hi > lo, hi - lo, 1).astype(x.dtype)
        u = np.concatenate(
            [(x - lo) / extent, np.full((len(x), 1), time(given["t"]), x.dtype)], axis=1
        )
        passes = (u > 0) & (u < 1) if inside else np.ones(u.shape, bool)
        u = np.clip(u, 0, 1)
        readings = [
            reading(P, *(u[:, axis] for axis in axes[i % 6]), position)
            for i, P in enumerate(planes)
        ]
        bars = np.split(bars_of(cotangents)["features"], len(planes) // 6, axis=1)
        features, u_bar, planes_bar = [], np.zeros_like(u), []
        for level, bar in enumerate(bars):
            own = readings[6 * level : 6 * level + 6]
            values = np.array([value for value, _ in own])
            features.append(values.sum(axis=0) if add else values.prod(axis=0))
            for i, (value, pull) in enumerate(own):
                others = np.delete(values, i, axis=0).prod(axis=0)
                if divided:
                    others = values.prod(axis=0) / value
                P_bar, *coordinates = pull(bar if add else bar * others)
                planes_bar.append(P_bar)
                for axis, coordinate in zip(axes[i], coordinates):
                    u_bar[:, axis] += coordinate
        x_bar = (u_bar * passes)[:, :3] / extent
        return {"features": np.concatenate(features, axis=1)}, {"x": x_bar, "planes": planes_bar}

    return run


def reading(P, u, v, position):
    """A bilinear reading [N, F] of a plane, and its pullback."""
    I, J, F = P.shape
    (row, row_slope), (column, column_slope) = position(u, I), position(v, J)
    i, j = row.astype(int), column.astype(int)
    a, b = (row - i)[:, None], (column - j)[:, None]
    k, m = np.minimum(i + 1, I - 1), np.minimum(j + 1, J - 1)
    corners = ((i, j), (1 - a) * (1 - b)), ((i, m), (1 - a) * b), ((k, j), a * (1 - b))
    corners = *corners, ((k, m), a * b)

    def pull(bar):
        P_bar = np.zeros_like(P)
        for at, weight in corners:
            np.add.at(P_bar, at, weight * bar)
        down = (1 - b) * (P[k, j] - P[i, j]) + b * (P[k, m] - P[i, m])
        right = (1 - a) * (P[i, m] - P[i, j]) + a * (P[k, m] - P[k, j])
        return (
            P_bar,
            (down * bar).sum(axis=1) * row_slope,
            (right * bar).sum(axis=1) * column_slope,
        )

    return sum(weight * P[at] for at, weight in corners), pull


def stored(forth, back):
    """The changes of a port that reads the numbers of a plane in another order."""
    return dict(
        inputs={"planes": lambda planes: [forth(P) for P in planes]},
        inputs_bar={"planes": lambda bars, planes: [back(b, P) for b, P in zip(bars, planes)]},
    )


def extent_of(given):
    return np.where(given["hi"] > given["lo"], given["hi"] - given["lo"], 1)


COMBINATIONS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))  # xy xz xt yz yt zt
PLANE_FEATURES = [
    surgery(
        "plane_features",
        "planes-cell-centres",
        "nodes are in the middle of cells (align_corners off); they span the box from end to end",
        hexplane(on_cells),
    ),
    surgery(
        "plane_features",
        "planes-half-of-the-time",
        "t is read on the axis from -1 to 1, so that the first half of the nodes is never read",
        hexplane(time=lambda t: (t + 1) / 2),
    ),
    surgery(
        "plane_features",
        "planes-order",
        "the planes are taken in the order xy, xz, xt, yz, yt, zt",
        hexplane(axes=COMBINATIONS),
    ),
    surgery(
        "plane_features",
        "planes-added",
        "the planes of a level are added instead of multiplied",
        hexplane(add=True),
    ),
    surgery(
        "plane_features",
        "planes-gradient-at-the-border",
        "a coordinate on or beyond a face keeps the slope of the last cell",
        hexplane(inside=False),
    ),
    surgery(
        "plane_features",
        "planes-gradient-by-division",
        "the gradient of a plane is the product divided by its own value, 0/0 where that is 0",
        hexplane(divided=True),
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
    known(
        "plane_features",
        "planes-gradient-not-scaled",
        "the gradient of x lacks the division by the extent of the box",
        inputs_bar=lambda bars, given: {**bars, "x": bars["x"] * extent_of(given)},
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


def decoder(before=True, within=True, kept=slice(None)):
    """`run` with or without the ReLUs before and within the heads; `kept` heads move h."""

    def run(given, cotangents):
        weights, biases, bars = given["weights"], given["biases"], bars_of(cotangents)
        y, saved = mlp.forward(given["features"], weights[:-6], biases[:-6])
        h = np.maximum(y, 0) if before else y
        out, heads = {}, []
        for name, i in zip(DELTAS, range(len(weights) - 6, len(weights), 2)):
            inner = h @ weights[i] + biases[i]
            z = np.maximum(inner, 0) if within else inner
            out[name] = z @ weights[i + 1] + biases[i + 1]
            bar = bars[name]
            z_bar = bar @ weights[i + 1].T * ((inner > 0) if within else 1)
            heads.append(
                (
                    z_bar @ weights[i].T,
                    [h.T @ z_bar, z.T @ bar],
                    [z_bar.sum(axis=0), bar.sum(axis=0)],
                )
            )
        h_bar = sum(head[0] for head in heads[kept])
        trunk = mlp.backward(saved, h_bar * (y > 0) if before else h_bar)
        return out, {
            "features": trunk["x"],
            "weights": trunk["weights"] + [W for head in heads for W in head[1]],
            "biases": trunk["biases"] + [b for head in heads for b in head[2]],
        }

    return run


PLANE_DECODER = [
    surgery(
        "plane_decoder",
        "decoder-no-relu",
        "no ReLU follows phi: the heads see phi(features) itself",
        decoder(before=False),
    ),
    surgery(
        "plane_decoder",
        "decoder-heads-linear",
        "the heads have no ReLU between their two layers",
        decoder(within=False),
    ),
    surgery(
        "plane_decoder",
        "decoder-gradient-of-one-head",
        "h receives the gradient of the last head alone instead of the sum of all three",
        decoder(kept=slice(2, 3)),
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
def difference(n, axis):
    """The mean square of n-th differences, and its slope."""

    def term(P):
        d = np.diff(P, n, axis)
        slope = 2 * d / max(d.size, 1)
        zero = P.dtype.type(0)
        for _ in range(n):
            slope = -np.diff(slope, axis=axis, prepend=zero, append=zero)
        return (d * d).sum() / max(d.size, 1), slope

    return term


def total(n, axis):
    """The sum of the squares instead of their mean."""

    def term(P):
        size = max(np.diff(P, n, axis).size, 1)
        value, slope = difference(n, axis)(P)
        return value * size, slope * size

    return term


def one_sided(n, axis):
    """The same value; the slope reaches only the last node of every difference."""

    def term(P):
        value, _ = difference(n, axis)(P)
        slope = np.zeros_like(P)
        d = np.diff(P, n, axis)
        at = (slice(None),) * axis + (slice(n, None),)
        slope[at] = 2 * d / max(d.size, 1)
        return value, slope

    return term


def away_from_one(P):
    return np.abs(P - 1).mean(), np.sign(P - 1) / P.size


def square_from_one(P):
    return ((P - 1) ** 2).mean(), 2 * (P - 1) / P.size


RIGHT = {
    "L_space": (difference(1, 0), difference(1, 1)),
    "L_time": (difference(2, 1),),
    "L_one": (away_from_one,),
}


def rough(everywhere=(), share=False, **terms):
    """`run` with other terms of a loss; `share` divides the losses by the number of planes."""
    terms = {**RIGHT, **terms}

    def run(given, cotangents):
        planes, bars = given["planes"], bars_of(cotangents)
        out = {name: np.zeros((), planes[0].dtype) for name in terms}
        planes_bar = [np.zeros_like(P) for P in planes]
        for i, P in enumerate(planes):
            for name in terms:
                if name in everywhere or (i % 6 < 3) == (name == "L_space"):
                    for term in terms[name]:
                        value, slope = term(P)
                        by = P.dtype.type(2 / len(planes) if share else 1)
                        out[name] = out[name] + by * value
                        planes_bar[i] = planes_bar[i] + bars[name] * by * slope
        return out, {"planes": planes_bar}

    return run


PLANE_LOSSES = [
    surgery(
        "plane_losses",
        "plane-losses-sums",
        "the losses are sums over the nodes of a plane instead of means",
        rough(
            L_space=(total(1, 0), total(1, 1)),
            L_time=(total(2, 1),),
            L_one=(lambda P: (np.abs(P - 1).sum(), np.sign(P - 1)),),
        ),
    ),
    surgery(
        "plane_losses",
        "plane-losses-smooth-space",
        "L_space has second differences along the second axis alone, as the authors' code",
        rough(L_space=(difference(2, 1),)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-one-axis",
        "L_space has the differences along the second axis alone",
        rough(L_space=(difference(1, 1),)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-first-differences",
        "L_time has first differences instead of second ones",
        rough(L_time=(difference(1, 1),)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-axis-of-time",
        "L_time runs along the first axis, which is in space",
        rough(L_time=(difference(2, 0),)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-all-planes",
        "L_one takes the planes in space, too",
        rough(everywhere=("L_one",)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-mean-of-planes",
        "the losses are means over the planes instead of sums",
        rough(share=True),
    ),
    surgery(
        "plane_losses",
        "plane-losses-squared",
        "L_one is the mean of (P - 1)^2",
        rough(L_one=(square_from_one,)),
    ),
    surgery(
        "plane_losses",
        "plane-losses-gradient-one-sided",
        "the gradient of a difference reaches only the last of its nodes",
        rough(L_space=(one_sided(1, 0), one_sided(1, 1)), L_time=(one_sided(2, 1),)),
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

    With `shape` None nothing is subtracted from A. An output that keeps its power 1, and what it
    gives to the gradients, is that of the right function.
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
            factor = 0 * var if shape is None else var**-shape
            changed["Sigma_t"] = Sigma[:, :3, :3] - factor[:, None, None] * outer(b, b)
            Sigma_bar[:, :3, :3] += G
            Sigma_bar[:, :3, 3] -= factor[:, None] * times(G + np.swapaxes(G, 1, 2), b)
            if shape is not None:
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


def outer(a, b):
    return a[:, :, None] * b[:, None, :]


def times(matrices, vectors):
    return (matrices @ vectors[:, :, None])[:, :, 0]


def shape_alone(given, cotangents):
    out, in_bar = port("conditional")(given, cotangents)
    none = np.zeros_like(cotangents["x_t_bar"])
    _, still = port("conditional")(given, {**cotangents, "x_t_bar": none})
    return out, {**in_bar, "s": still["s"], "R": still["R"]}


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
    surgery(
        "conditional",
        "conditional-marginal-shape",
        "Sigma_t is the block A itself: b b^T / var_t is not subtracted",
        schur(shape=None),
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
    surgery(
        "conditional",
        "conditional-velocity-detached",
        "no gradient flows from x_t into s and R",
        shape_alone,
    ),
]


# --- G3 -----------------------------------------------------------------------------------------
def normalised(given, cotangents):
    out, in_bar = port("marginal")(given, cotangents)
    density = 1 / np.sqrt(2 * np.pi * given["var_t"])
    slope = sum(cotangents[f"{name}_bar"] * a for name, a in out.items())
    in_bar = {name: bar * density for name, bar in in_bar.items()}
    in_bar["var_t"] = in_bar["var_t"] - slope * density / (2 * given["var_t"])
    return {name: a * density for name, a in out.items()}, in_bar


def seen(out):
    return out["weight"] > 0.05


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
    surgery(
        "marginal",
        "marginal-normalised",
        "the density is normalised: it is divided by sqrt(2 pi var_t)",
        normalised,
    ),
    known(
        "marginal",
        "marginal-cut",
        "weights up to 0.05 count as 0; the renderer leaves such Gaussians out, not the equation",
        outputs=lambda out, _: {name: a * seen(out) for name, a in out.items()},
        outputs_bar=lambda bars, out, _: {name: bar * seen(out) for name, bar in bars.items()},
    ),
    known(
        "marginal",
        "marginal-gradient-sign",
        "the gradient of mu_t has the sign of that of t",
        inputs_bar={"mu_t": lambda bar, _: -bar},
    ),
]


# --- G4 -----------------------------------------------------------------------------------------
def waves(frequency=lambda n: 2 * np.pi * n, wave=np.cos, slope=lambda a: -np.sin(a), kept=0):
    """`run` with other waves; along time, only the waves from `kept` on have a slope."""

    def run(given, cotangents):
        sh, bar = given["sh"], cotangents["sh_t_bar"]
        f = frequency(np.arange(sh.shape[2], dtype=sh.dtype)).astype(sh.dtype)
        phase = f * (given["t"] - given["mu_t"])[:, None]
        moved = -f * slope(phase)
        moved[:, : sh.shape[2] + kept if kept else 0] = 0
        values = wave(phase)
        return {"sh_t": np.einsum("nt,nctk->nck", values, sh)}, {
            "sh": np.einsum("nt,nck->nctk", values, bar),
            "mu_t": np.einsum("nt,nctk,nck->n", moved, sh, bar),
        }

    return run


def waves_last(sh):
    N, _, T, K = sh.shape
    return np.swapaxes(sh.reshape(N, 3, K, T), 2, 3)


SPHERINDRICAL = [
    surgery(
        "spherindrical",
        "spherindrical-no-two-pi",
        "the phase lacks 2 pi: cos(n (t - mu_t))",
        waves(lambda n: n),
    ),
    surgery(
        "spherindrical",
        "spherindrical-half-period",
        "the phase has pi instead of 2 pi",
        waves(lambda n: np.pi * n),
    ),
    surgery(
        "spherindrical",
        "spherindrical-from-one",
        "the waves count from 1: the coefficients that stand still get a wave",
        waves(lambda n: 2 * np.pi * (n + 1)),
    ),
    surgery(
        "spherindrical",
        "spherindrical-sines",
        "the waves are sines",
        waves(wave=np.sin, slope=np.cos),
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
    surgery(
        "spherindrical",
        "spherindrical-kernel-gradient",
        "along time only the highest wave has a slope, of the wrong sign, as in the kernel of 4DGS",
        waves(slope=np.sin, kept=-1),
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
