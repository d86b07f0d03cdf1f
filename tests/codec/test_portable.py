"""Decoding gives the same on every machine.

It depends neither on the order of a library's sums, nor on its exponentials or threads, nor on the
float context.
"""

import os
from math import frexp, ldexp
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.special

from p4dgs_ref.arithmetic import CHOSEN
from p4dgs_ref.codec import context as integer_context
from p4dgs_ref.codec.context import coding_context, integer_layers, log2, run_network
from p4dgs_ref.codec.file import decode, encode
from p4dgs_ref.codec.gaussian_table import lookup_table
from p4dgs_ref.equations.prior import layout
from tests import processes
from tests.codec.models import DECODE_AND_PRINT, digest, random_model
from tests.sampling import few

SEVERAL = dict(
    anchors=400,
    hidden=(9, 7),
    context=(33, 21),
    F=3,
    grid_3d=(4, 20),
    grid_2d=(7, 40),
    table_3d=500,
    table_2d=300,
)


@pytest.fixture(scope="module")
def coded():
    """A model, its file, and the digest of the decoded model on this machine as it is."""
    model = random_model(11, **SEVERAL)
    data = encode(model)
    return model, data, digest(decode(data))


# --- The float context is not used ---


# --- Neither the order of a sum nor a library's exponential matters ---


def reversed_sums(x, W):
    """Add term by term, from the last input to the first."""
    y = np.zeros((len(x), W.shape[1]))
    for i in reversed(range(len(W))):
        y += x[:, i : i + 1] * W[i]
    return y


def halved_sums(x, W):
    """Add in a tree, as threads do."""
    if len(W) < 2:
        return x @ W
    half = len(W) // 2
    return halved_sums(x[:, half:], W[half:]) + halved_sums(x[:, :half], W[:half])


PRODUCTS = {
    "reversed": reversed_sums,
    "tree": halved_sums,
    "extended": lambda x, W: (x.astype(np.longdouble) @ W.astype(np.longdouble)).astype(float),
    "integers": lambda x, W: (x.astype(np.int64) @ W.astype(np.int64)).astype(float),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_any_order_of_summation_decodes_the_same(coded, monkeypatch, name):
    model, data, expected = coded
    called = []

    def product(x, W):
        called.append(x.shape)
        return PRODUCTS[name](x, W)

    def interpolate(subscripts, weight, signs):
        called.append("hash grid")
        return sum(weight[:, c, None] * signs[:, c] for c in reversed(range(weight.shape[1])))

    monkeypatch.setattr(integer_context, "product", product)
    monkeypatch.setattr(integer_context.np, "einsum", interpolate)
    assert digest(decode(data)) == expected
    # Three layers each of psi_q and psi_p, and eight levels.
    assert len(called) == 2 * 3 + 8
    assert called.count("hash grid") == 8
    assert encode(model) == data


def test_functions_one_ulp_off_decode_the_same(coded, monkeypatch):
    """exp, tanh, log2 and similar functions of NumPy and SciPy are all rounded up."""
    _, data, expected = coded

    def up(function):
        return lambda *args, **kwargs: np.nextafter(function(*args, **kwargs), np.inf)

    of_numpy = (
        "exp exp2 expm1 log log2 log10 log1p tanh sinh cosh "
        "sin cos tan arctan power float_power cbrt"
    )
    of_scipy = "erf erfc erfcx ndtr log_ndtr ndtri expit logit"
    for module, names in ((np, of_numpy), (scipy.special, of_scipy)):
        for name in names.split():
            monkeypatch.setattr(module, name, up(getattr(module, name)))
    assert np.exp(0.0) > 1 and scipy.special.expit(0.0) > 0.5
    assert digest(decode(data)) == expected


def dispatched():
    """The processor features that this NumPy chooses among at run time."""
    core = getattr(np, "_core", None) or np.core
    return " ".join(core._multiarray_umath.__cpu_dispatch__)


MACHINES = [
    {
        "OPENBLAS_NUM_THREADS": "1",
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": "all",
    },
    {"OPENBLAS_NUM_THREADS": "2", "OPENBLAS_CORETYPE": "Haswell"},
    {"OPENBLAS_NUM_THREADS": "4"},
]


@pytest.mark.slow
@pytest.mark.parametrize("machine", MACHINES)
def test_other_kernels_and_threads_decode_the_same(coded, tmp_path, machine):
    """Sums without fused multiply-add, in other block sizes and threads; loops without SIMD.

    The last one has the processor's own kernels, unlike this process.
    """
    _, data, expected = coded
    (tmp_path / "model.p4dgs").write_bytes(data)
    machine = {name: dispatched() if value == "all" else value for name, value in machine.items()}
    others = {name: value for name, value in os.environ.items() if name not in CHOSEN}
    program = ("-W", "ignore", "-c", DECODE_AND_PRINT, tmp_path / "model.p4dgs")
    done = processes.run(*program, env={**others, **machine})
    assert done.stdout.split() == [expected, "True"], done.stderr


# --- The reason: every sum is one of integers below 2^53 ---


WIDEST = 2**14
NETWORKS = {
    "widest input": (WIDEST, 3, 2),
    "widest hidden layer": (5, WIDEST, 3),
    "deepest": (6,) * 10,
    "one layer": (7, 4),
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("scale", few([65504.0, 1.9990234375, 1.0, 6e-8], 2))
def test_largest_networks_equal_pythons_integers(name, scale):
    """Weights at the ends of float16, of one sign and of both, with the largest inputs."""
    rng, widths = np.random.default_rng(5), NETWORKS[name]
    signs = [
        rng.choice([-1.0, 1.0], pair) if i % 2 else np.ones(pair)
        for i, pair in enumerate(zip(widths[:-1], widths[1:]))
    ]
    weights = [s * np.float16(scale).astype(float) for s in signs]
    biases = [np.full(n, 65504.0) * rng.choice([-1, 1], n) for n in widths[1:]]
    x = np.full((2, widths[0]), 2**15)
    x[1] = rng.integers(-(2**15), 2**15 + 1, widths[0])
    layers = integer_layers(weights, biases)
    y = run_network(x.astype(float), layers).astype(int).tolist()
    for row, outputs in zip(x.tolist(), y):
        want = network_in_integers(row, weights, biases)
        assert (outputs, layers[-1].bits, layers[-1].bound) == want
    assert max(layer.bound for layer in layers) < 2**52
    for layer in layers:
        assert np.abs(layer.W).max() < 2**15
        assert np.array_equal(layer.W, np.rint(layer.W))


def network_in_integers(x, weights, biases):
    """Return outputs, fractional bits and bound of a network: the format page in Python's integers.

    The letters are those of the page, parts a to d of NETWORKS.
    """
    a, X = 15, 2**15
    for W, b in zip(weights, biases):
        p, p_b = (frexp(np.abs(values).max())[1] for values in (W, b))
        n = min(15 - p, 50 - p_b - a, 24)
        columns = [[round(ldexp(w, n)) for w in column] for column in W.T.tolist()]
        b = [round(ldexp(v, a + n)) for v in b.tolist()]
        a += n
        y = [sum(x_i * w for x_i, w in zip(x, column)) + v for column, v in zip(columns, b)]
        B = X * max(sum(map(abs, column)) for column in columns) + max(map(abs, b))
        s = max(0, B.bit_length() - 22)
        last, x = (y, a, B), [max(0, (value + 2**s // 2) >> s) for value in y]
        a, X = a - s, (B + 2**s // 2) >> s
    return last


def rounded(value, s, limit):
    """floor(value / 2^s + 1/2) for an s of either sign, clipped: Python's integers alone."""
    shifted = (value + (1 << s >> 1)) >> s if s > 0 else value << -s
    return max(-limit, min(limit, shifted))


def test_means_are_shifted_as_the_format_says():
    """m R 2^-S, rounded and clipped, where R has 24 bits and |m R| <= 2^52; S has either sign."""
    rng, limit = np.random.default_rng(3), integer_context.MU_LIMIT
    R = rng.integers(2**23 + 1, 2**24, 300)
    values = rng.integers(-(2**28), 2**28, 300) // 2 ** rng.integers(0, 29, 300) * R
    for S in (*range(-70, 70, 7), *range(-12, 13), *range(25, 31), 52, 53, 54, 62, 63):
        want = [rounded(value, S, limit) for value in values.tolist()]
        assert integer_context.shift(values, np.int64(S)).tolist() == want, S


@pytest.mark.parametrize("bits, limit", [(12, 2**15), (16, 2**24)])
def test_outputs_are_rescaled_as_the_format_says(bits, limit):
    """y 2^(bits - unit), rounded and clipped."""
    rng = np.random.default_rng(4)
    y = rng.integers(-(2**51), 2**51, 300) // 2 ** rng.integers(0, 51, 300)
    for s in (-80, -40, *range(-31, 60)):
        want = [rounded(value, s, limit) for value in y.tolist()]
        found = integer_context.rescale(y.astype(float), bits + s, bits, limit)
        assert found.tolist() == want, s


def test_steps_are_rounded_as_the_format_says():
    """For every output of psi_q. Where `share` ends in 128, q_units is rounded up."""
    psi_q = integer_layers([np.full((1, 4), 8.0)], [np.zeros(4)])  # the output is the input
    psi_p = integer_layers([np.zeros((1, 8))], [np.zeros(8)])
    groups = SimpleNamespace(Q_0=(1.0, 1.0, 1.0, 1.0), widths=(1, 1, 1, 1))
    outputs = np.arange(-(2**15), 2**15 + 1)
    q = integer_context.context_of(outputs[:, None].astype(float), psi_q, psi_p, groups)[0]
    sigmoid, ties = lookup_table("sigmoid").tolist(), 0
    for u, found in zip(outputs.tolist(), (q[:, 0] * 2**15).tolist()):
        i, r = divmod(max(0, min(u + 4 * 2**12, 10 * 2**12 - 1)), 64)
        share = sigmoid[i] + (sigmoid[i + 1] - sigmoid[i]) * r // 64
        ties += share % 256 == 128
        want = max(32, min((share + 128) // 256, 65536))
        assert found == want, f"u = {u}, share = {share}: q_units = {found:g}, expected {want}"
    assert ties > 100


def test_a_bound_is_reached():
    """The largest inputs and weights reach the bound, so it cannot be lower."""
    (layer,) = integer_layers([np.full((WIDEST, 1), 65504.0)], [np.full(1, 65504.0)])
    assert run_network(np.full((1, WIDEST), 2.0**15), [layer])[0, 0] == layer.bound > 2**43


def test_networks_beyond_the_bound_are_not_run():
    """Only a network wider than a header allows exceeds the bound."""
    wide = 2**17
    with pytest.raises(AssertionError, match="a partial sum could be rounded"):
        integer_layers([np.ones((1, wide)), np.ones((wide, 1))], [np.zeros(wide), np.zeros(1)])


def test_every_bit_of_log2_is_that_of_the_page():
    """The last bit of the rest changes one result in a hundred by 2^-16."""
    rng, table = np.random.default_rng(0), lookup_table("log2").tolist()
    values = np.append(rng.integers(2**28, 2**40, 5000), 2 ** np.arange(41))
    for value, found in zip(values.tolist(), log2(values).tolist()):
        n = value.bit_length() - 1
        i, r = divmod((value << 23 >> n) - 2**23, 2**15)
        assert found == (n << 16) + table[i] + ((table[i + 1] - table[i]) * r >> 15)


def test_deviations_are_clipped_before_the_smallest_step_divides_them():
    """Without weights in its last layer, psi_p gives its biases for every anchor."""
    model = random_model(3, anchors=2, Q_f=1e-5, Q_s=1e-5, Q_l=1e-5, Q_O=1e-5)
    weights, biases = model.networks["psi_p"]
    mu_columns, raw_columns = layout(model.design.widths)
    raw = np.linspace(-20, 10, len(raw_columns)).astype(np.float16)
    weights[-1][...], biases[-1][mu_columns], biases[-1][raw_columns] = 0, 0, raw
    ctx = coding_context(model.design, model.networks, model.grids, np.zeros((1, 3), np.int64))
    sigma = np.exp(np.clip(raw.astype(float), -14, 6)) / np.repeat(ctx.q, model.design.widths)
    wanted = np.clip(np.log2(sigma), -8, 20 - 1 / 16)
    assert np.abs(ctx.sigma_units[0] / 16 - wanted).max() <= 0.51 / 16
