"""Eqs. (7) to (14) against stored high-precision constants, exact fractions and slow loops."""

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

from p4dgs_ref.equations import (
    anchor_rate,
    grid_nodes,
    hash_grid,
    hash_rate,
    likelihood,
    rounding,
)

DATA = Path(__file__).parents[1] / "golden" / "data"
# Bits and their slopes in f_noisy and q with 60 digits, for mu = 0, sigma = 1 and z >= 0.
ROWS = json.loads((DATA / "gaussian_bin_constants.json").read_text())["rows"]
Z, W, BITS, BITS_F, BITS_Q = (np.array(column)[None] for column in zip(*ROWS))
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])
SIGNS = pytest.mark.parametrize("sign", [1, -1])


def rate(z, w, mu=0.0, sigma=1.0, dtype=np.float64):
    """Bits, and their derivatives by f_noisy, mu, sigma and q, in units of 1 / sigma."""
    z, w = np.broadcast_arrays(np.asarray(z, float), w)
    inputs = (mu + sigma * z, mu + 0 * z, sigma + 0 * z, sigma * w)
    bits, saved = likelihood.forward(*(a.astype(dtype) for a in inputs))
    gradients = likelihood.backward(saved, np.ones_like(bits))
    return bits, {name: sigma * slope for name, slope in gradients.items()}


# --- Eq. (11): bits and gradients ----------------------------------------------------------------


def allowed(relative):
    """The error granted to the bits of every row.

    It is `relative` above a millionth of a bit, and everywhere 4 units in the last place times the
    condition number: the inputs' own rounding.
    """
    condition = (np.abs(Z * BITS_F) + np.abs(W * BITS_Q)) / np.maximum(BITS, 1e-300)
    rounding_error = 4 * np.finfo(float).eps * (1 + condition)
    return np.maximum(np.where(BITS > 1e-6, relative, 0), rounding_error) * BITS + 1e-300


def check_bits_and_slopes(bits, slopes, sign, relative, slope_error, rows=slice(None)):
    """Compare with the constants; slopes are judged against the larger density of the two edges."""
    assert np.all(np.abs(bits - BITS)[0, rows] <= allowed(relative)[0, rows])
    density = 2 * np.abs(BITS_Q)  # at least the larger density over the mass
    wanted = {
        "f_noisy": (sign * BITS_F, density),
        "mu": (-sign * BITS_F, density),
        "q": (BITS_Q, density),
        "sigma": (-(Z * BITS_F + W * BITS_Q), (Z + W) * density),
    }
    for name, (want, largest) in wanted.items():
        error = np.abs(slopes[name] - want)
        assert np.all(error[0, rows] <= slope_error * largest[0, rows] + 1e-300), name


def test_the_constants_cover_every_regime():
    narrow = np.maximum(W, Z * W) < likelihood.NARROW
    low = Z - W / 2
    regimes = {
        "narrow, far out": narrow & (low > 8),
        "narrow, around the mean": narrow & (low < 0),
        "far from the mean": ~narrow & (low > likelihood.FAR),
        "around the mean": ~narrow & (low < 0),
        "beside the mean": ~narrow & (low > 0) & (low < likelihood.FAR),
        "almost no bits": (BITS < 1e-6) & (BITS > 0),
        "no bits": BITS == 0,
    }
    for name, rows in regimes.items():
        assert rows.sum() >= 8, name
    assert Z.max() == 1000 and W.max() == 1e6 and W.min() == 1e-12


@SIGNS
@pytest.mark.parametrize(
    "mu, sigma", [(0.0, 1.0), (8.0, 1.0), (0.0, 2.0**-30), (0.0, 2.0**-13), (0.0, 2.0**20)]
)
def test_likelihood_against_constants(mu, sigma, sign):
    """Scaling by a power of two is exact, and so is z + 8 where z has few digits."""
    exact = (Z[0] % 0.5 == 0) | (mu == 0)
    assert exact.sum() > 100
    check_bits_and_slopes(*rate(sign * Z, W, mu, sigma), sign, 1e-12, 1e-12, exact)


@SIGNS
def test_slope_of_sigma_where_an_edge_lies_on_the_mean(sign):
    """There log p depends on sigma through the far edge alone, by high phi(high) / p."""
    high = np.array([[1.5, 3.0, 10.0, 30.0]])
    density = np.exp(-(high**2) / 2) / np.sqrt(2 * np.pi)
    want = high * density / (ndtr(high) - 0.5) / np.log(2)
    _, slopes = rate(sign * high / 2, high)
    np.testing.assert_allclose(slopes["sigma"], want, rtol=1e-13)


@SIGNS
def test_likelihood_in_float32(sign):
    exact = ((Z.astype(np.float32) == Z) & (W.astype(np.float32) == W))[0]
    assert exact.sum() >= 40
    bits, slopes = rate(sign * Z, W, dtype=np.float32)
    assert bits.dtype == np.float32
    assert all(a.dtype == np.float32 for a in slopes.values())
    check_bits_and_slopes(bits, slopes, sign, 2e-6, 2e-6, exact & (BITS[0] > 1e-6))
    # The other rows are rounded to float32 first. The tests above show that float64 is right there.
    z, w = Z.astype(np.float32).astype(float), W.astype(np.float32).astype(float)
    wanted, _ = rate(sign * z, w)
    assert np.all(np.abs(bits - wanted) <= 2e-6 * wanted + 1e-37)


def test_regimes_side_by_side_and_in_any_memory_order():
    """A row alone, in one array with all others, and in a transposed array: the same bits."""
    together, _ = rate(Z, W)
    alone = [rate(Z[:, [i]], W[:, [i]])[0][0, 0] for i in range(Z.size)]
    transposed, _ = rate(Z.reshape(2, -1).T, W.reshape(2, -1).T)
    assert np.array_equal(together[0], alone)
    assert np.array_equal(together, transposed.T.reshape(1, -1))


def test_pieces_meet(monkeypatch):
    """Long arrays are computed piece by piece; the size of a piece changes nothing."""
    z, w = np.tile(Z, 3), np.tile(W, 3)
    whole, slopes = rate(z, w)
    monkeypatch.setattr(likelihood, "PIECE", 7)
    pieces, slopes_of_pieces = rate(z, w)
    assert np.array_equal(whole, pieces)
    assert all(np.array_equal(slopes[name], slopes_of_pieces[name]) for name in slopes)


@pytest.mark.parametrize("name", ["sigma", "q"])
def test_likelihood_names_what_is_not_positive(name):
    inputs = {key: np.ones((3, 2)) for key in ("f_noisy", "mu", "sigma", "q")}
    for value in (0.0, -1.0):
        inputs[name][1, 0] = value
        with pytest.raises(ValueError, match=rf"{name}\[1, 0\]"):
            likelihood.forward(**inputs)


# --- Eq. (7) -------------------------------------------------------------------------------------


# --- Eq. (8) -------------------------------------------------------------------------------------


# --- Eq. (9) -------------------------------------------------------------------------------------


def test_levels_must_match():
    x_a, lo, hi = np.zeros((1, 3)), np.zeros(3), np.ones(3)
    with pytest.raises(ValueError):
        hash_grid.forward(x_a, lo, hi, [np.ones((4, 1))], (("xy", 2), ("xz", 2)))
    with pytest.raises(ValueError):
        grid_nodes.nodes(x_a, lo, hi, "xw", 2, 4)


# --- Eq. (10) ------------------------------------------------------------------------------------


@BOTH
def test_rounding_against_exact_fractions(dtype):
    rng = np.random.default_rng(4)
    q = rng.uniform(0.01, 3, size=(400, 1)).astype(dtype)
    f = (q * rng.normal(scale=50, size=(400, 5))).astype(dtype)
    if dtype == np.float32:  # a quotient in float32 would call many of these a tie
        f[:, :4] = ((rng.integers(-9, 9, size=(400, 4)) + 0.5) * q).astype(dtype)
    (symbols, f_hat), _ = rounding.forward(f, q)
    if dtype == np.float32:
        assert np.sum(np.rint(f / q) != symbols) > 100
    for row, s, found in zip(f, q[:, 0], symbols.tolist()):
        assert found == [round(Fraction(float(v)) / Fraction(float(s))) for v in row]
    assert symbols.dtype == np.int64 and f_hat.dtype == dtype
    assert np.array_equal(f_hat, (symbols * q.astype(float)).astype(dtype))
    assert np.all(np.abs(f_hat - f) <= q * (0.5 + 100 * np.finfo(dtype).eps))


@BOTH
def test_rounding_has_one_zero(dtype):
    f = np.array([[-0.0, -0.4, -0.5]], dtype)
    (symbols, f_hat), _ = rounding.forward(f, np.ones((1, 1), dtype))
    assert not symbols.any() and not np.signbit(f_hat).any()


@BOTH
@pytest.mark.parametrize("value", [2.0**31 + 256, -(2.0**31) - 256, np.nan, np.inf])
def test_rounding_names_a_value_that_does_not_fit(dtype, value):
    f, q = np.ones((4, 3), dtype), np.ones((4, 1), dtype)
    f[2, 1] = value
    with pytest.raises(OverflowError, match=r"f\[2, 1\]"):
        rounding.forward(f, q)
    f[2, 1] = np.copysign(2.0**31, value)
    assert rounding.forward(f, q)[0][0][2, 1] == f[2, 1]  # the largest symbols of a file


@BOTH
@pytest.mark.parametrize("value", [1, 0])
def test_rounding_names_the_first_value_with_a_step_of_zero(dtype, value):
    f, q = np.ones((4, 3), dtype), np.ones((4, 1), dtype)
    f[2, 1], q[2] = value, 0
    with pytest.raises(OverflowError, match=r"f\[2, 0\]"):
        rounding.forward(f, q)


# --- Eq. (12) ------------------------------------------------------------------------------------


# --- Eqs. (13) and (14) --------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("rows, sign", [(None, 1), (0, 1), (5, 1), (5, -1)])
def test_hash_rate_of_agreeing_signs(dtype, rows, sign):
    grids = [] if rows is None else [np.full((rows, 2), sign, dtype)]
    (R_hash, _, _), saved = hash_rate.forward(grids)
    assert R_hash == 0
    assert not any(grid.any() for grid in hash_rate.backward(saved, dtype(3))["grids"])


@pytest.mark.slow
@pytest.mark.parametrize("dtype, error", [("float64", 1e-11), ("float32", 1.2e-7)])
def test_a_hundred_million_bits_are_added_up(dtype, error):
    """H-R7: a sum in float32 that adds one number after the other is off by 1 %."""
    row = (2 + np.sin(np.arange(100.0))).astype(dtype)
    bits_f = np.broadcast_to(row, (10**6, 100))
    none, no_children = np.zeros((10**6, 3), dtype), np.zeros((10**6, 0, 3), dtype)
    R_anchor, _ = anchor_rate.forward(
        bits_f=bits_f, bits_s=none, bits_l=none, bits_O=no_children, mask=no_children[..., 0] > 0
    )
    assert float(R_anchor) == pytest.approx(10**6 * math.fsum(row.tolist()), rel=error)
