"""Known mistakes in the encoding of position and time and in Eqs. (5) and (6)."""

from functools import partial
from types import SimpleNamespace

import numpy as np

from p4dgs_ref.equations import mlp, positional_encoding
from p4dgs_ref.equations.numerics import normalise, normalise_backward
from tests.workshop.mistakes.kit import (
    edited,
    given_as,
    inverse,
    known,
    layer_transposed,
    no_gradient,
    port,
    relu,
    squares_transposed,
    surgery,
    with_module,
)
from tests.workshop.rewriting import edited as edited_equation

# --- positional encoding ------------------------------------------------------------------------


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


FREQUENCIES = "np.ldexp(1.0, np.arange(L)).astype(dtype)"
ENCODING = [
    edited(
        "positional_encoding",
        "encoding-pi",
        "the frequencies have a factor pi: sin(2^j pi p)",
        {FREQUENCIES: "(np.pi * (1 << np.arange(L))).astype(dtype)"},
    ),
    edited(
        "positional_encoding",
        "encoding-two-pi",
        "the frequencies have a factor 2 pi: sin(2^j 2 pi p)",
        {FREQUENCIES: "(2 * np.pi * (1 << np.arange(L))).astype(dtype)"},
    ),
    edited(
        "positional_encoding",
        "encoding-degrees",
        "p is taken for degrees: sin(2^j p pi / 180)",
        {FREQUENCIES: "(np.pi / 180 * (1 << np.arange(L))).astype(dtype)"},
    ),
    edited(
        "positional_encoding",
        "encoding-from-one",
        "the frequencies are 2^1 ... 2^L instead of 2^0 ... 2^(L-1)",
        {FREQUENCIES: "(2 << np.arange(L)).astype(dtype)"},
    ),
    edited(
        "positional_encoding",
        "encoding-linear",
        "the frequencies are 1, 2, 3 ... instead of 1, 2, 4 ...",
        {FREQUENCIES: "(1 + np.arange(L)).astype(dtype)"},
    ),
    edited(
        "positional_encoding",
        "encoding-gradient-frequency",
        "the gradient lacks the factor 2^j of its frequency",
        {
            "np.tensordot(powers_of_two(L, angles_bar.dtype), angles_bar, axes=1)": (
                "angles_bar.sum(axis=0)"
            ),
        },
    ),
    edited(
        "positional_encoding",
        "encoding-gradient-sign",
        "the derivative of cos has the sign of +sin",
        {
            "waves[:, 1] * waves_bar[:, 0] - waves[:, 0]": (
                "waves[:, 1] * waves_bar[:, 0] + waves[:, 0]"
            ),
        },
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


IMPORTED = "from . import mlp, positional_encoding"


def with_encoding(id, description, wrong):
    """A port without a positional encoding of its own, whose E(x) and E(t) are wrong."""
    return with_module(
        "deformation",
        id,
        description,
        "positional_encoding",
        (IMPORTED, "from . import mlp"),
        wrong,
    )


def of_frequencies(text):
    """A positional encoding with other frequencies."""
    return lambda: edited_equation("positional_encoding", {FREQUENCIES: f"({text}).astype(dtype)"})


def with_cosines_first():
    def forward(p, L):
        E, saved = positional_encoding.forward(p, L)
        return E[:, cosines_first(p.shape[1], L)], (saved, p.shape[1])

    def backward(saved, E_bar):
        (E, L), D = saved
        return positional_encoding.backward((E, L), E_bar[:, inverse(cosines_first(D, L))])

    return SimpleNamespace(forward=forward, backward=backward)


def linear_before_heads():
    """An mlp without the ReLU before its last layer, which is that of the heads."""

    def forward(x, weights, biases):
        y, saved = mlp.forward(x, weights[:-1], biases[:-1]) if weights[1:] else (x, None)
        return y @ weights[-1] + biases[-1], (saved, y, weights)

    def backward(saved, y_bar, needs_x=True):
        trunk, y, weights = saved
        last = {"weights": [y.T @ y_bar], "biases": [y_bar.sum(axis=0)]}
        bar = y_bar @ weights[-1].T
        if trunk is None:
            return {"x": bar, **last} if needs_x else last
        first = mlp.backward(trunk, bar, needs_x)
        return first | {name: [*first[name], *bars] for name, bars in last.items()}

    return SimpleNamespace(forward=forward, backward=backward)


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
        "deformation-square-transposed",
        "square weights are transposed: as PyTorch stores them, or twice",
        inputs={"weights": squares_transposed},
        inputs_bar={"weights": squares_transposed},
    ),
    with_encoding(
        "deformation-frequencies-from-one",
        "the frequencies of E are 2^1 ... 2^L instead of 2^0 ... 2^(L-1)",
        of_frequencies("2 << np.arange(L)"),
    ),
    with_encoding(
        "deformation-pi",
        "the frequencies of E have a factor pi: sin(2^j pi p)",
        of_frequencies("np.pi * (1 << np.arange(L))"),
    ),
    with_encoding(
        "deformation-two-pi",
        "the frequencies of E have a factor 2 pi: sin(2^j 2 pi p)",
        of_frequencies("2 * np.pi * (1 << np.arange(L))"),
    ),
    with_encoding(
        "deformation-cosines-first",
        "E has the cosines of a frequency before its sines",
        with_cosines_first,
    ),
    with_module(
        "deformation",
        "deformation-no-relu-before-heads",
        "no ReLU stands between the trunk's last layer and the heads",
        "mlp",
        (IMPORTED, "from . import positional_encoding"),
        linear_before_heads,
    ),
    *(
        known(
            "deformation",
            f"deformation-{name}-transposed",
            f"the weight of {says} is transposed: as PyTorch stores it, or twice",
            **layer_transposed(i),
        )
        for name, i, says in (
            ("first", 0, "the trunk's first layer"),
            ("second", 1, "the trunk's second layer"),
            ("rotation", -1, "the head of rotation"),
        )
    ),
    known(
        "deformation",
        "deformation-time-symmetric",
        "the time from 0 to 1 is mapped to -1 to 1 before E(t)",
        **given_as(t=lambda given: 2 * given["t"] - 1),
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


def multiplied(given, cotangents, product=TABLE, one=0):
    """r_t is the unit quaternion along (one + delta_r) r where rotation is on."""
    r, delta = given["r"], given["delta_r"]
    if not delta.shape[1]:
        return port("deformed")(given, cotangents)
    out, in_bar = port("deformed")({**given, "delta_r": delta[:, :0]}, cotangents)
    table, turn = product.astype(r.dtype), delta + np.array([one, 0, 0, 0], r.dtype)
    r_t, norm = normalise(np.einsum("ijk,nj,nk->ni", table, turn, r))
    bar = normalise_backward(r_t, norm, cotangents["r_t_bar"])
    r_bar = np.einsum("ijk,ni,nj->nk", table, bar, turn)
    delta_bar = np.einsum("ijk,ni,nk->nj", table, bar, r)
    return {**out, "r_t": r_t}, {**in_bar, "r": r_bar, "delta_r": delta_bar}


DEFORMED = [
    edited(
        "deformed",
        "deformed-not-normalised",
        "delta_r is added after the normalisation: r_t is not of unit length",
        {"if delta_r.shape[1]:": "if False:"},
    ),
    edited(
        "deformed",
        "deformed-delta-normalised",
        "delta_r is normalised before it is added",
        {
            "add_delta(r, delta_r)": (
                "add_delta(r, normalise(delta_r)[0] if delta_r.size else delta_r)"
            ),
            "(r_t, norm, widths)": "((r_t, delta_r), norm, widths)",
            "r_t, norm, (width_x, width_s, width_r) = saved": (
                "(r_t, delta_r), norm, (width_x, width_s, width_r) = saved"
            ),
            "r_bar[:, :width_r]": (
                "normalise_backward(*normalise(delta_r), r_bar) if width_r else r_bar[:, :0]"
            ),
        },
    ),
    surgery(
        "deformed",
        "deformed-product",
        "the quaternions are multiplied, delta_r r, instead of added",
        multiplied,
    ),
    surgery(
        "deformed",
        "deformed-product-right",
        "the quaternions are multiplied, r delta_r, instead of added",
        partial(multiplied, product=TABLE.swapaxes(1, 2)),
    ),
    surgery(
        "deformed",
        "deformed-turned",
        "delta_r is taken relative to (1, 0, 0, 0) and multiplied: (1 + delta_r) r",
        partial(multiplied, one=1),
    ),
    surgery(
        "deformed",
        "deformed-turned-right",
        "delta_r is taken relative to (1, 0, 0, 0) and multiplied: r (1 + delta_r)",
        partial(multiplied, product=TABLE.swapaxes(1, 2), one=1),
    ),
    edited(
        "deformed",
        "deformed-gradient-not-normalised",
        "the normalisation of r_t is missing in backward alone",
        {"normalise_backward(r_t, norm, r_t_bar)": "r_t_bar"},
    ),
    edited(
        "deformed",
        "deformed-log-scale",
        "delta_s is added to the logarithm: s_t = s exp(delta_s)",
        {
            "add_delta(s, delta_s), add_delta(r": (
                "(s * np.exp(delta_s) if delta_s.shape[1] else s), add_delta(r"
            ),
            "(r_t, norm, widths)": "((r_t, s, delta_s), norm, widths)",
            "r_t, norm, (width_x": "(r_t, s, delta_s), norm, (width_x",
            '"s": s_t_bar': '"s": s_t_bar * (np.exp(delta_s) if width_s else 1)',
            "s_t_bar[:, :width_s]": "(s_t_bar * s)[:, :width_s] * np.exp(delta_s)",
        },
    ),
    edited(
        "deformed",
        "deformed-clamped-scale",
        "negative scales are set to zero",
        {
            "add_delta(s, delta_s), add_delta(r": (
                "(np.maximum(s + delta_s, 0) if delta_s.shape[1] else s), add_delta(r"
            ),
            "(r_t, norm, widths)": "((r_t, s_t), norm, widths)",
            "r_t, norm, (width_x": "(r_t, s_t), norm, (width_x",
            '"s": s_t_bar': '"s": s_t_bar * (s_t > 0 if width_s else 1)',
            "s_t_bar[:, :width_s]": "(s_t_bar * (s_t > 0))[:, :width_s]",
        },
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
