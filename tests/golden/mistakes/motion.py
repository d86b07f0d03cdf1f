"""Known mistakes in the encoding of position and time and in Eqs. (5) and (6)."""

import numpy as np

from p4dgs_ref.equations.numerics import normalise, normalise_backward
from tests.golden.mistakes.kit import bars_of, inverse, known, no_gradient, port, relu, surgery


# --- positional encoding ------------------------------------------------------------------------
def encoded(frequencies, slope=(1, -1), slope_powers=None):
    """`run` of E with other frequencies(L).

    `slope` has the signs of sin' and cos'; `slope_powers` gives other frequencies in backward.
    """

    def run(given, cotangents):
        p, L = given["p"], given["L"]
        f = np.asarray(frequencies(L), p.dtype)
        g = f if slope_powers is None else np.asarray(slope_powers(L), p.dtype)
        N, D = p.shape
        angles = p[:, None, :] * f[:, None]  # (N, L, D)
        waves = np.stack([np.sin(angles), np.cos(angles)], axis=2)  # (N, L, 2, D)
        bar = bars_of(cotangents)["E"]
        waves_bar = bar[:, D:].reshape(N, L, 2, D)
        slopes = (
            slope[0] * waves[:, :, 1] * waves_bar[:, :, 0]
            + slope[1] * waves[:, :, 0] * waves_bar[:, :, 1]
        )
        return (
            {"E": np.concatenate([p, waves.reshape(N, 2 * L * D)], axis=1)},
            {"p": bar[:, :D] + (slopes * g[:, None]).sum(axis=1)},
        )

    return run


def powers(L):
    return 2.0 ** np.arange(L)


def columns(order):
    """E with its columns in the order `order(D, L)`: what stands at i is our column order[i]."""

    def index(given):
        return order(given["p"].shape[1], given["L"])

    return dict(
        outputs=lambda out, given: {"E": out["E"][:, index(given)]},
        outputs_bar=lambda bars, out, given: {"E": bars["E"][:, inverse(index(given))]},
    )


def arranged(*axes, raw_last=False):
    """The waves' columns (L, 2, D) with the axes in another order; the raw input first or last."""

    def order(D, L):
        waves = D + np.arange(2 * L * D).reshape(L, 2, D).transpose(axes).ravel()
        return np.concatenate([waves, np.arange(D)] if raw_last else [np.arange(D), waves])

    return order


def cosines_first(D, L):
    return np.concatenate(
        [np.arange(D), D + np.arange(2 * L * D).reshape(L, 2, D)[:, ::-1].ravel()]
    )


ENCODING = [
    surgery(
        "positional_encoding",
        "encoding-pi",
        "the frequencies have a factor pi: sin(2^j pi p)",
        encoded(lambda L: np.pi * powers(L)),
    ),
    surgery(
        "positional_encoding",
        "encoding-degrees",
        "p is taken for degrees: sin(2^j p pi / 180)",
        encoded(lambda L: np.pi / 180 * powers(L)),
    ),
    surgery(
        "positional_encoding",
        "encoding-from-one",
        "the frequencies are 2^1 ... 2^L instead of 2^0 ... 2^(L-1)",
        encoded(lambda L: 2 * powers(L)),
    ),
    surgery(
        "positional_encoding",
        "encoding-linear",
        "the frequencies are 1, 2, 3 ... instead of 1, 2, 4 ...",
        encoded(lambda L: 1.0 + np.arange(L)),
    ),
    surgery(
        "positional_encoding",
        "encoding-gradient-frequency",
        "the gradient lacks the factor 2^j of its frequency",
        encoded(powers, slope_powers=np.ones),
    ),
    surgery(
        "positional_encoding",
        "encoding-gradient-sign",
        "the derivative of cos has the sign of +sin",
        encoded(powers, slope=(1, 1)),
    ),
    known(
        "positional_encoding",
        "encoding-no-raw",
        "the raw input is missing: sines and cosines alone",
        outputs=lambda out, given: {"E": out["E"][:, given["p"].shape[1] :]},
        outputs_bar=lambda bars, out, given: {
            "E": bars["E"] * (np.arange(out["E"].shape[1]) >= given["p"].shape[1])
        },
    ),
    known(
        "positional_encoding",
        "encoding-raw-last",
        "the raw input comes last instead of first",
        **columns(arranged(0, 1, 2, raw_last=True)),
    ),
    known(
        "positional_encoding",
        "encoding-interleaved",
        "per frequency sin x, cos x, sin y, cos y ... instead of all sines, then all cosines",
        **columns(arranged(0, 2, 1)),
    ),
    known(
        "positional_encoding",
        "encoding-by-coordinate",
        "coordinate by coordinate instead of frequency by frequency",
        **columns(arranged(2, 0, 1)),
    ),
    known(
        "positional_encoding",
        "encoding-sines-first",
        "the sines of all frequencies, then the cosines of all",
        **columns(arranged(1, 0, 2)),
    ),
    known(
        "positional_encoding",
        "encoding-cosines-first",
        "cosines before sines",
        **columns(cosines_first),
    ),
]


# --- Eq. (5) ------------------------------------------------------------------------------------
def rows_moved(tree, by):
    """Move the rows of the first layer down.

    It is the trunk's first layer, or all heads where there is no trunk.
    """
    weights = tree["weights"]
    n = 1 if len(weights) > 3 else 3
    return {**tree, "weights": [*(np.roll(W, by, axis=0) for W in weights[:n]), *weights[n:]]}


def exchanged(tree, *_):
    return {**tree, "delta_x": tree["delta_s"], "delta_s": tree["delta_x"]}


def exchanged_bar(bars, out, given):
    """Where one of the heads has no width, the cotangents stay."""
    return exchanged(bars) if out["delta_x"].shape == out["delta_s"].shape else bars


HEADS = ("delta_x", "delta_s", "delta_r")
IDENTITY = (1, 0, 0, 0)


def headless(given, keep):
    """Inputs whose three heads have the biases keep(b)."""
    return {**given, "biases": [*given["biases"][:-3], *map(keep, given["biases"][-3:])]}


def relu_shown(out, _):
    return {name: relu(a)[0] for name, a in out.items()}


DEFORMATION = [
    known(
        "deformation",
        "deformation-time-first",
        "the network's input is (E(t), E(x)) instead of (E(x), E(t))",
        inputs=lambda given: rows_moved(given, -1 - 2 * given["L_t"]),
        inputs_bar=lambda bars, given: rows_moved(bars, 1 + 2 * given["L_t"]),
    ),
    known(
        "deformation",
        "deformation-heads-swapped",
        "the heads of position and scale are exchanged",
        outputs=exchanged,
        outputs_bar=exchanged_bar,
    ),
    known(
        "deformation",
        "deformation-heads-relu",
        "a ReLU follows the heads",
        outputs=relu_shown,
        outputs_bar={name: lambda bar, y: bar * (y > 0) for name in HEADS},
    ),
    known(
        "deformation",
        "deformation-heads-no-bias",
        "the heads have no bias",
        inputs=lambda given: headless(given, np.zeros_like),
        inputs_bar=lambda bars, given: headless(bars, np.zeros_like),
    ),
    known(
        "deformation",
        "deformation-identity-added",
        "delta_r is returned relative to the quaternion (1, 0, 0, 0)",
        outputs={"delta_r": lambda r: r + np.array(IDENTITY, r.dtype)[: r.shape[1]]},
    ),
    known(
        "deformation",
        "deformation-no-gradient-of-x",
        "the gradient of x is stopped before E(x), as the pipeline does; the equation has it",
        inputs_bar={"x": no_gradient},
    ),
]


# --- Eq. (6) ------------------------------------------------------------------------------------
def turned(add, add_bar):
    """`run` with r_t = add(r, delta_r) where rotation is on; add_bar gives both gradients."""

    def run(given, cotangents):
        bars = bars_of(cotangents)
        off = {**given, "delta_r": given["delta_r"][:, :0]}
        rest = port("deformed")
        if not given["delta_r"].shape[1]:
            return rest(given, cotangents)
        out, in_bar = rest(off, {name + "_bar": bar for name, bar in bars.items()})
        r, delta = given["r"], given["delta_r"]
        r_bar, delta_bar = add_bar(bars["r_t"], r, delta)
        return {**out, "r_t": add(r, delta)}, {**in_bar, "r": r_bar, "delta_r": delta_bar}

    return run


def unit(r):
    return normalise(r)[0]


def unit_bar(bar, r):
    return normalise_backward(*normalise(r), bar)


def both(bar):
    return bar, bar


def delta_first_bar(bar, r, delta):
    bar = unit_bar(bar, r + unit(delta))
    return bar, unit_bar(bar, delta)


# Hamilton's product p = a b: p_i = sum_jk TABLE[i, j, k] a_j b_k
TABLE = np.zeros((4, 4, 4))
for _i, _row in enumerate(
    (
        [(0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)],
        [(0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)],
        [(0, 2, 1), (2, 0, 1), (3, 1, 1), (1, 3, -1)],
        [(0, 3, 1), (3, 0, 1), (1, 2, 1), (2, 1, -1)],
    )
):
    for _j, _k, _sign in _row:
        TABLE[_i, _j, _k] = _sign


def product(delta, r):
    return np.einsum("ijk,nj,nk->ni", TABLE.astype(r.dtype), delta, r)


def product_bar(bar, r, delta):
    bar, table = unit_bar(bar, product(delta, r)), TABLE.astype(r.dtype)
    return np.einsum("ijk,ni,nj->nk", table, bar, delta), np.einsum("ijk,ni,nk->nj", table, bar, r)


def when_on(f):
    """Change s_t where scaling is on."""

    def change(tree, *others):
        given = others[-1]
        return (
            {**tree, "s_t": f(tree["s_t"], given, *others[:-1])}
            if given["delta_s"].shape[1]
            else tree
        )

    return change


def log_scaled_bar(bars, given):
    """The gradient of s exp(delta_s), made of that of s + delta_s."""
    if not given["delta_s"].shape[1]:
        return bars
    growth = np.exp(given["delta_s"])
    return {**bars, "s": bars["s"] * growth, "delta_s": bars["delta_s"] * growth * given["s"]}


DEFORMED = [
    surgery(
        "deformed",
        "deformed-not-normalised",
        "delta_r is added after the normalisation: r_t is not of unit length",
        turned(lambda r, delta: r + delta, lambda bar, r, delta: both(bar)),
    ),
    surgery(
        "deformed",
        "deformed-delta-normalised",
        "delta_r is normalised before it is added",
        turned(lambda r, delta: unit(r + unit(delta)), delta_first_bar),
    ),
    surgery(
        "deformed",
        "deformed-product",
        "the quaternions are multiplied, delta_r r, instead of added",
        turned(lambda r, delta: unit(product(delta, r)), product_bar),
    ),
    surgery(
        "deformed",
        "deformed-gradient-not-normalised",
        "the normalisation of r_t is missing in backward alone",
        turned(lambda r, delta: unit(r + delta), lambda bar, r, delta: both(bar)),
    ),
    known(
        "deformed",
        "deformed-log-scale",
        "delta_s is added to the logarithm: s_t = s exp(delta_s)",
        outputs=lambda out, given: when_on(lambda s_t, g: g["s"] * np.exp(g["delta_s"]))(
            out, given
        ),
        inputs_bar=log_scaled_bar,
    ),
    known(
        "deformed",
        "deformed-clamped-scale",
        "negative scales are set to zero",
        outputs=lambda out, given: when_on(lambda s_t, g: np.maximum(s_t, 0))(out, given),
        outputs_bar=lambda bars, out, given: when_on(lambda bar, g, o: bar * (o["s_t"] > 0))(
            bars, out, given
        ),
    ),
    known(
        "deformed",
        "deformed-position-scaled",
        "delta_x is in units of the Gaussian's scale: x + s delta_x",
        outputs=lambda out, given: (
            {**out, "x_t": given["x"] + given["s"] * given["delta_x"]}
            if given["delta_x"].shape[1]
            else out
        ),
        inputs_bar=lambda bars, given: (
            {
                **bars,
                "s": bars["s"] + bars["x"] * given["delta_x"],
                "delta_x": bars["delta_x"] * given["s"],
            }
            if given["delta_x"].shape[1]
            else bars
        ),
    ),
]

MISTAKES = [*ENCODING, *DEFORMATION, *DEFORMED]
