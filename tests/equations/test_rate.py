"""Eqs. (9) to (13): pieces and regimes, what is refused, and zeros."""

import itertools
import json
import math

import numpy as np
import pytest

from p4dgs_ref.equations import (
    anchor_rate,
    grid_nodes,
    hash_grid,
    hash_rate,
    likelihood,
    rounding,
)
from tests import ROOT

# Rows of every regime of Eq. (11).
BINS = ROOT / "tests" / "workshop" / "data" / "gaussian_bin_constants.json"
Z, W, *_ = (
    np.array(column)[None] for column in zip(*json.loads(BINS.read_text(encoding="utf-8"))["rows"])
)
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])


def rate(z, w):
    """Bits and their derivatives, for mu = 0 and sigma = 1."""
    bits, saved = likelihood.forward(z, 0 * z, 0 * z + 1, w)
    return bits, likelihood.backward(saved, np.ones_like(bits))


# --- Eq. (11) ----------------------------------------------------------------


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


@BOTH
@pytest.mark.parametrize("name", ["sigma", "q"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_likelihood_names_what_is_not_positive(name, value, dtype):
    inputs = {key: np.ones((3, 2), dtype) for key in ("f_noisy", "mu", "sigma", "q")}
    inputs[name][1, 0] = value
    with pytest.raises(ValueError, match=rf"{name}\[1, 0\]"):
        likelihood.forward(**inputs)


def test_likelihood_of_integers_asks_for_floats():
    with pytest.raises(ValueError, match="f_noisy: expected floats, got int64"):
        likelihood.forward(*np.ones((4, 3, 2), np.int64))


LEAST, MOST = 2.0**-1022, 2.0**1022
ENDS = (5e-324, LEAST, 1e-300, 1e-10, 1.0, 1e10, 1e300, MOST)


@np.errstate(all="ignore")
@pytest.mark.parametrize("sigma, q", [*itertools.product(ENDS, ENDS)])
def test_slopes_are_finite_or_the_ratio_is_refused(sigma, q):
    """Whatever sigma and q are, at distances where the true slopes are finite."""
    inputs = [np.array([[0, 0.3 * sigma]]), *(np.full((1, 2), a) for a in (0.0, sigma, q))]
    if all(LEAST <= a <= MOST for a in (sigma, q, q / sigma)):
        bits, saved = likelihood.forward(*inputs)
        gradients = likelihood.backward(saved, np.ones_like(bits))
        assert np.isfinite([bits, *gradients.values()]).all()
    else:
        with pytest.raises(ValueError, match=r"\[0, 0\] is "):
            likelihood.forward(*inputs)


@BOTH
@pytest.mark.parametrize("factors", [(0.1, 1), (1, 0.1)])
def test_slopes_that_a_precision_cannot_hold_are_refused(factors, dtype):
    """Factors of the smallest number with all digits, for sigma and q."""
    sigma, q = (np.full((1, 1), np.finfo(dtype).tiny * factor, dtype) for factor in factors)
    with pytest.raises(ValueError, match=r"\[0, 0\] is "):
        likelihood.forward(0 * q, 0 * q, sigma, q)


# --- Eq. (9) -------------------------------------------------------------------------------------


def test_levels_must_match_and_coordinates_be_finite():
    x_a, lo, hi = np.zeros((1, 3)), np.zeros(3), np.ones(3)
    with pytest.raises(ValueError, match=r"x_a\[0, 0\] is nan"):
        grid_nodes.nodes(x_a * np.nan, lo, hi, "xy", 2, 4)
    with pytest.raises(ValueError, match="finite corners"):
        grid_nodes.nodes(x_a, lo, np.full(3, np.inf), "xy", 2, 4)
    with pytest.raises(ValueError):
        hash_grid.forward(x_a, lo, hi, [np.ones((4, 1))], (("xy", 2), ("xz", 2)))
    with pytest.raises(ValueError):
        grid_nodes.nodes(x_a, lo, hi, "xw", 2, 4)


# --- Eq. (10) ------------------------------------------------------------------------------------


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


# --- Eq. (13) --------------------------------------------------------------------------


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
