"""Decoding gives the same on every machine.

It depends neither on the order of a library's sums, nor on its exponentials or threads, nor on the
float context.
"""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.special

import p4dgs_ref as p4
from p4dgs_ref import model as pipelines
from p4dgs_ref.codec import context as integer_context
from p4dgs_ref.codec import fixed_point
from p4dgs_ref.codec.file import ATTRIBUTE_SECTIONS, decode, encode
from p4dgs_ref.codec.fixed_point import (
    ACTIVATION_BITS,
    INPUT_BITS,
    Layer,
    run_network,
    whole_layers,
)
from p4dgs_ref.codec.quantise import quantise
from p4dgs_ref.codec.streams import ideal_bits_gaussian
from p4dgs_ref.equations import hash_grid, likelihood, mlp, prior, step
from p4dgs_ref.model import split
from p4dgs_ref.report.inspect import float_context, ledger
from tests.codec.models import DECODE_AND_PRINT, MAKE, changed, digest, random_model
from tests.golden.sample_model import sample_model
from tests.sampling import few

ROOT = Path(__file__).resolve().parents[2]
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


def test_the_float_context_is_not_used(coded, monkeypatch):
    """Its functions raise here; encoding and decoding do not call them, but the ledger does."""

    def refuse(*args, **kwargs):
        raise AssertionError("the float context was used")

    model, data, expected = coded
    for owner, name in (
        (pipelines, "context"),
        (hash_grid, "locate"),
        (hash_grid, "query"),
        (step, "forward"),
        (prior, "forward"),
        (mlp, "forward"),
        (likelihood, "forward"),
    ):
        monkeypatch.setattr(owner, name, refuse)
    assert encode(model) == data and digest(decode(data)) == expected
    with pytest.raises(AssertionError, match="was used"):
        ledger(data)


@pytest.mark.parametrize("towards", [-np.inf, np.inf])
def test_one_ulp_in_every_output_of_the_float_context_changes_nothing(coded, monkeypatch, towards):
    model, data, expected = coded
    before = float_context(model)

    def nudged(function):
        def run(*args, **kwargs):
            output, saved = function(*args, **kwargs)
            if isinstance(output, tuple):
                return tuple(np.nextafter(a, towards) for a in output), saved
            return np.nextafter(output, towards), saved

        return run

    for module in (hash_grid, step, prior):  # h, q, and mu with sigma
        name = "query" if module is hash_grid else "forward"
        monkeypatch.setattr(module, name, nudged(getattr(module, name)))
    after = float_context(model)
    # In most numbers the errors of h and of the output do not cancel.
    assert all((a != b).mean() > 0.5 for a, b in zip(before, after))
    assert encode(model) == data and digest(decode(data)) == expected


# --- Neither the order of a sum nor a library's exponential matters ---


def reversed_sums(x, W):
    """Add term by term, from the last input to the first."""
    y = np.zeros((len(x), W.shape[1]))
    for i in reversed(range(len(W))):
        y += x[:, i : i + 1] * W[i]
    return y


def scattered_sums(x, W):
    """Add the terms in ascending order, in every other output in descending order."""
    y = np.zeros((len(x), W.shape[1]))
    for j in range(W.shape[1]):
        terms = np.sort(x * W[:, j], axis=1)[:, :: 1 - 2 * (j % 2)]
        if terms.size:
            y[:, j] = np.cumsum(terms, axis=1)[:, -1]
    return y


def halved_sums(x, W):
    """Add in a tree, as threads do."""
    if len(W) < 2:
        return x @ W
    half = len(W) // 2
    return halved_sums(x[:, half:], W[half:]) + halved_sums(x[:, :half], W[:half])


PRODUCTS = {
    "reversed": reversed_sums,
    "scattered": scattered_sums,
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

    monkeypatch.setattr(fixed_point, "product", product)
    monkeypatch.setattr(integer_context.np, "einsum", interpolate)
    assert digest(decode(data)) == expected
    # Three layers each of psi_q and psi_p, and eight levels.
    assert len(called) == 2 * 3 + 8
    assert called.count("hash grid") == 8
    assert encode(model) == data


def test_orders_differ_where_numbers_are_not_whole():
    """The products above add in different orders: for real numbers they differ."""
    rng = np.random.default_rng(0)
    x, W = rng.normal(size=(50, 300)), rng.normal(size=(300, 5))
    results = [product(x, W).tobytes() for name, product in PRODUCTS.items() if name != "integers"]
    assert len({*results, (x @ W).tobytes()}) >= 4


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


@pytest.mark.parametrize("machine", MACHINES)
def test_other_kernels_and_threads_decode_the_same(coded, tmp_path, machine):
    """Sums without fused multiply-add, in other block sizes and threads; loops without SIMD."""
    _, data, expected = coded
    (tmp_path / "model.p4dgs").write_bytes(data)
    machine = {name: dispatched() if value == "all" else value for name, value in machine.items()}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", DECODE_AND_PRINT, tmp_path / "model.p4dgs"],
        cwd=ROOT,
        env={**os.environ, **machine},
        capture_output=True,
        text=True,
    )
    assert done.stdout.split() == [expected, "True"], done.stderr


# --- The reason: every sum is one of integers below 2^53 ---


def by_hand(x, weights, biases):
    """`fixed_point.py` in Python's own integers: outputs, largest partial sum, fractional bits."""
    a, X, largest = INPUT_BITS, 2**INPUT_BITS, 0
    x = [[int(v) for v in row] for row in x]
    for i, (W, b) in enumerate(zip(weights, biases)):
        n = min(15 - exponent(W), 50 - exponent(b) - a, 24)
        columns = [[round(math.ldexp(v, n)) for v in column] for column in np.transpose(W)]
        shifts = [round(math.ldexp(v, a + n)) for v in b]
        terms = [[[v * w for v, w in zip(row, column)] for column in columns] for row in x]
        y = [[sum(part) + c for part, c in zip(row, shifts)] for row in terms]
        for row in terms:
            sums = [sum(map(abs, part)) + abs(c) for part, c in zip(row, shifts)]
            largest = max(largest, *sums)
        B = X * max(sum(map(abs, column)) for column in columns) + max(map(abs, shifts))
        a += n
        if i < len(weights) - 1:
            s = max(0, B.bit_length() - ACTIVATION_BITS)
            x = [[max(0, v + 2**s // 2 >> s) for v in row] for row in y]
            a, X = a - s, B + 2**s // 2 >> s
    return y, largest, a


def exponent(values):
    """The least integer p with |v| < 2^p for all values v."""
    return max((math.frexp(abs(v))[1] for v in np.ravel(values)), default=0)


WIDEST = 2**14
NETWORKS = {
    "widest input": (WIDEST, 3, 2),
    "widest hidden layer": (5, WIDEST, 3),
    "deepest": (6,) * 10,
    "one layer": (7, 4),
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("scale", [65504.0, 1.9990234375, 1.0, 6e-8])
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
    layers = whole_layers(weights, biases)
    expected, largest, unit = by_hand(x, weights, biases)
    y = run_network(x.astype(float), layers)
    assert [[int(v) for v in row] for row in y] == expected
    assert layers[-1].bits == unit
    assert largest <= max(layer.bound for layer in layers) < 2**52
    for layer in layers:
        assert np.abs(layer.W).max() < 2**15
        assert np.array_equal(layer.W, np.rint(layer.W))


def test_a_bound_is_reached():
    """The largest inputs and weights reach the bound, so it cannot be lower."""
    (layer,) = whole_layers([np.full((WIDEST, 1), 65504.0)], [np.full(1, 65504.0)])
    assert run_network(np.full((1, WIDEST), 2.0**15), [layer])[0, 0] == layer.bound > 2**43
    assert isinstance(layer, Layer)


def test_networks_beyond_the_bound_are_not_run():
    """Only a network wider than a header allows exceeds the bound."""
    wide = 2**17
    with pytest.raises(AssertionError, match="a partial sum could be rounded"):
        whole_layers([np.ones((1, wide)), np.ones((wide, 1))], [np.zeros(wide), np.zeros(1)])


# --- The integers are nevertheless those of the trained model ---


@pytest.fixture(scope="module")
def trained():
    stages = (60, 90, 200, 400)
    return p4.train(p4.load_scene("bouncing"), preset="tiny", stage_ends=stages, anchors=80)


@pytest.mark.slow
def test_the_integer_context_costs_a_trained_model_nothing(trained, record_property):
    """It changes the bits by less than 0.1 %, and the whole coder by less than 0.3 %."""
    q = quantise(trained)
    ctx, exact = q.context, float_context(q.model)
    steps = np.repeat(ctx.q, q.model.design.widths, axis=1)
    mu, sigma = ctx.mu_units / 1024 * steps, 2.0 ** (ctx.sigma_units / 16) * steps
    values = q.symbols * steps
    wanted = likelihood.forward(values, exact.mu, exact.sigma, steps)[0][q.kept].sum()
    found = likelihood.forward(values, mu, sigma, steps)[0][q.kept].sum()
    arrays = (q.symbols, ctx.mu_units, ctx.sigma_units)
    coder = ideal_bits_gaussian(*(array[q.kept] for array in arrays)).sum()
    record_property("integer_context_percent", 100 * (found / wanted - 1))
    record_property("coder_percent", 100 * (coder / wanted - 1))
    assert wanted > 5000
    assert abs(found / wanted - 1) < 0.001
    assert abs(coder / wanted - 1) < 0.003


def drawn(seed, anchors, low, high, **fields):
    """A model drawn from its own float prior, with sigma / q from about exp(low) to exp(high)."""
    model = random_model(seed, anchors=anchors, **fields)
    rng, widths = np.random.default_rng(seed), model.design.widths
    (weights, biases), (mu, raw) = model.networks["psi_p"], prior.layout(widths)
    q = np.repeat(model.design.Q_0, widths)
    last, b = weights[-1].copy(), biases[-1].copy()
    last[:, mu], last[:, raw] = last[:, mu] * q, 0.1 * last[:, raw]
    b[mu], b[raw] = rng.uniform(-3, 3, len(q)) * q, np.log(q) + rng.uniform(low, high, len(q))
    networks = {**model.networks, "psi_p": ([*weights[:-1], last], [*biases[:-1], b])}
    zero = {name: 0 * getattr(model.anchors, name) for name in ("f_a", "s_a", "l_a", "O_a")}
    model = quantise(dataclasses.replace(changed(model, **zero), networks=networks)).model
    exact = float_context(model)
    f, s, l, O = split(exact.mu + exact.sigma * rng.normal(size=exact.mu.shape), model.design)
    return changed(model, f_a=f, s_a=s, l_a=l, O_a=O)


def rare(seed, share):
    """A model whose masks and hash grid have few ones, or few zeros."""
    grid = dict(grid_3d=(40,), grid_2d=(90,), table_3d=2**16, table_2d=2**13, F=2)
    model = random_model(seed, anchors=3000, k=4, **grid)
    rng = np.random.default_rng(seed)
    mask = rng.random(model.anchors.mask.shape) < max(share, 0.01)
    mask[:, 0] |= share > 0.5
    grids = [np.where(rng.random(g.shape) < share, 1.0, -1.0) for g in model.grids]
    return dataclasses.replace(changed(model, mask=mask), grids=grids)


SIZED = {
    **MAKE,
    **{f"sigma {low}": lambda low=low: drawn(3, 2500, low, low + 2) for low in range(-5, 9, 2)},
    "every sigma": lambda: drawn(4, 2500, -5, 8),
    "few": lambda: drawn(5, 40, -3, 2),
    "wide": lambda: drawn(6, 300, -2, 1, d=64, k=12),
    "sample": lambda: sample_model(7, 300),
    **{
        f"ones {share}": lambda share=share: rare(9, share)
        for share in (0.0, 1e-4, 0.02, 0.5, 0.97, 0.9999, 1.0)
    },
}


@pytest.mark.parametrize("name", few([*SIZED, "trained longer"], 8))
def test_every_section_has_the_size_of_its_entropy(name, request):
    """It is at most 0.3 % and 16 bytes above the entropy under the float64 model.

    It is not below the entropy of its own frequencies, but an outlier may cost less than under the
    float model, whose tail has no escape. sigma / q stays above 2^-8, the least of the format:
    below it a symbol costs almost nothing, and that little depends on the rounding of mu.
    """
    model = request.getfixturevalue("trained") if name == "trained longer" else SIZED[name]()
    rows = {row["name"]: row for row in ledger(encode(model))}
    for section in (*ATTRIBUTE_SECTIONS, "masks", "hash_grid"):
        row = rows[section]
        assert row["integer_bytes"] - 1 <= row["bytes"] <= 1.003 * row["estimate_bytes"] + 16, row
