"""Eqs. (7) to (14) against stored high-precision constants, exact fractions and slow loops."""

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.equations import (
    anchor_rate,
    grid_nodes,
    hash_grid,
    hash_rate,
    likelihood,
    noise,
    prior,
    rounding,
    step,
)

DATA = Path(__file__).parents[1] / "golden" / "data"
# Bits and their slopes in f_noisy and q with 60 digits, for mu = 0, sigma = 1 and z >= 0.
ROWS = json.loads((DATA / "gaussian_bin_constants.json").read_text())["rows"]
Z, W, BITS, BITS_F, BITS_Q = (np.array(column)[None] for column in zip(*ROWS))
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])
SIGNS = pytest.mark.parametrize("sign", [1, -1])

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


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
def test_likelihood_against_constants(sign):
    check_bits_and_slopes(*rate(sign * Z, W), sign, 1e-12, 1e-12)


@SIGNS
@pytest.mark.parametrize("sigma", [2.0**-30, 2.0**-13, 2.0**20])
def test_likelihood_scales_with_sigma(sign, sigma):
    """These sigmas are powers of two, so that scaling by them is exact."""
    check_bits_and_slopes(*rate(sign * Z, W, sigma=sigma), sign, 1e-12, 1e-12)


@SIGNS
def test_likelihood_depends_on_the_distance_to_mu(sign):
    exact = Z[0] % 0.5 == 0  # then z + 8 has no rounding error
    assert exact.sum() > 100
    check_bits_and_slopes(*rate(sign * Z, W, mu=8.0), sign, 1e-12, 1e-12, exact)


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


def test_far_outliers_are_pulled_back():
    z = np.array([[6.0, 9, 20, 40, 1000, 1e6]])
    for w in (1e-12, 1e-4, 1.0, 3.0):
        (above, slopes), (below, opposite) = rate(z, w), rate(-z, w)
        assert np.isfinite(above).all() and np.array_equal(above, below)
        assert np.array_equal(slopes["f_noisy"], -opposite["f_noisy"])
        assert np.array_equal(slopes["f_noisy"], -slopes["mu"])
        assert np.all(slopes["f_noisy"] > 0)
        # Far out the slope grows about linearly with the distance.
        assert np.abs(slopes["f_noisy"] * math.log(2) / z - 1).max() < 0.4
        assert np.all(np.diff(above) > 0)


def test_regimes_meet():
    """Bits and slopes do not jump where one formula hands over to another."""
    borders = [(z, likelihood.NARROW / max(1, z)) for z in (0, 0.5, 1, 2, 8, 30, 1000)]  # narrow
    borders += [(w / 2, w) for w in (0.05, 1, 10, 100)]  # low = 0: around the mean or beside it
    borders += [(likelihood.FAR + w / 2, w) for w in (0.05, 1, 10, 1e3)]  # beside the mean or far
    for z, w in borders:
        near_z = z * (1 + 1e-13 * np.array([[-1, 1, -1, 1, 0]]))
        near_w = w * (1 + 1e-13 * np.array([[-1, -1, 1, 1, 0]]))
        bits, slopes = rate(near_z, near_w)
        assert np.ptp(bits) <= 1e-9 * np.abs(bits).max() + 1e-15, (z, w)
        steepest = (1 + z + w) * np.abs(slopes["q"]).max()
        for name, slope in slopes.items():
            scale = max(np.abs(slope).max(), steepest)
            assert np.ptp(slope) <= 1e-9 * scale + 1e-15, (z, w, name)


def test_masses_of_all_bins_add_up_to_one():
    for mu, sigma in ((0.3, 0.2), (-1.7, 4.0), (0.5, 60.0)):
        k = np.arange(-700.0, 701)[None]
        bits, _ = rate((k - mu) / sigma, 1 / sigma)
        assert math.fsum(2.0 ** -bits[0]) == pytest.approx(1, abs=1e-13)


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


def test_the_printed_formula_fails_where_the_literature_says():
    def literal(z, dtype):
        one = np.ones((1, 1), dtype)
        with np.errstate(divide="ignore"):
            return likelihood.literal(z * one, 0 * one, one, one)[0, 0]

    assert literal(4, np.float64) == pytest.approx(12.0909, abs=1e-4)
    assert literal(9, np.float64) == np.inf
    assert literal(6, np.float32) == np.inf


@pytest.mark.parametrize("name", ["sigma", "q"])
def test_likelihood_names_what_is_not_positive(name):
    inputs = {key: np.ones((3, 2)) for key in ("f_noisy", "mu", "sigma", "q")}
    for value in (0.0, -1.0):
        inputs[name][1, 0] = value
        with pytest.raises(ValueError, match=rf"{name}\[1, 0\]"):
            likelihood.forward(**inputs)


# --- Eq. (7) -------------------------------------------------------------------------------------


def test_noise_has_the_deviation_of_a_rounding_error():
    u = np.random.default_rng(1).uniform(-0.5, 0.5, size=(2, 40000))
    q = np.array([[0.5], [3.0]])
    f_noisy, _ = noise.forward(np.zeros_like(u), u, q)
    assert f_noisy.std(axis=1) == pytest.approx(q[:, 0] / math.sqrt(12), rel=0.01)
    assert np.all(np.abs(f_noisy) <= q / 2)


# --- Eq. (8) -------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("u", [-1e4, -100, -19, -10, -3.9, -3, -0.5, 0, 0.5, 3, 19, 100, 1e4])
def test_steps(u, dtype):
    """psi_q is u in every group, because the weights are ones and the biases zeros."""
    weights, biases = [np.ones((1, 4), dtype)], [np.zeros(4, dtype)]
    Q_0 = np.array([0.5, 0.01, 0.01, 0.1], dtype)
    eps = np.finfo(dtype).eps
    factor = 2 / (1 + math.exp(min(-2 * u, 700.0)))  # 1 + tanh(u)
    q, saved = step.forward(np.array([[u]], dtype), weights, biases, Q_0)
    assert q.dtype == dtype and np.all(q > 0)
    wanted = max(factor, 2.0**-10) * np.array([0.5, 0.01, 0.01, 0.1])
    assert q[0] == pytest.approx(wanted, rel=10 * float(eps))

    slope = 0.0  # on the floor
    if factor > 2.0**-10:
        slope = 4 / (math.exp(min(u, 350.0)) + math.exp(min(-u, 350.0))) ** 2
    q_bar = np.random.default_rng(2).normal(size=(1, 4)).astype(dtype)
    terms = q_bar[0].astype(float) * (0.5, 0.01, 0.01, 0.1)
    h_bar = step.backward(saved, q_bar)["h"]
    assert h_bar.dtype == dtype
    error = abs(h_bar[0, 0] - slope * terms.sum())
    assert error <= 20 * eps * slope * np.abs(terms).sum() + 1e-38


# --- Eq. (9) -------------------------------------------------------------------------------------


def test_hash_of_a_known_node():
    """Node (1, 1, 1) is 1 ^ 2654435761 ^ 805459861 = 2922720805, modulo 8192 = 3621."""
    x = np.full((1, 3), 0.5)
    index, weight = grid_nodes.nodes(x, np.zeros(3), np.full(3, 32.0), "xyz", 33, 8192)
    assert index.dtype == np.int64
    assert index[0, 0] == 0 and index[0, -1] == 3621
    assert np.array_equal(weight, np.full((1, 8), 0.125))


def slow_nodes(x, lo, hi, axes, res, table):
    """The weights of one position, corner by corner in exact integers: {entry: weight}."""
    places = []
    for name in axes:
        i = "xyz".index(name)
        u = (x[i] - lo[i]) / (hi[i] - lo[i]) if hi[i] > lo[i] else 0.0
        places.append(min(max(u, 0.0), 1.0) * (res - 1))
    found = {}
    for corner in range(2 ** len(axes)):
        ups = [corner >> j & 1 for j in range(len(axes))]
        node = [min(int(place) + up, res - 1) for place, up in zip(places, ups)]
        entry = sum(c * res**j for j, c in enumerate(node))
        if res ** len(axes) > table:
            primes = (1, 2654435761, 805459861)
            entry = 0
            for c, prime in zip(node, primes):
                entry ^= c * prime % 2**32
            entry %= table
        weight = math.prod(place % 1 if up else 1 - place % 1 for place, up in zip(places, ups))
        found[entry] = found.get(entry, 0.0) + weight
    return found


@pytest.mark.parametrize("tables", [(125, 49, 49, 49), (16, 8, 1, 49), (8192, 10, 48, 50)])
def test_hash_grid_against_a_loop(tables):
    rng = np.random.default_rng(3)
    lo, hi = np.array([-1.0, 2, -3]), np.array([1.0, 2, 4])  # no extent along y
    special = [lo, hi, (lo + hi) / 2, lo + [0.5, 0, 1.75]]
    x_a = np.concatenate([rng.uniform(-5, 5, size=(30, 3)), special])
    resolutions = (("xyz", 5), ("xy", 7), ("xz", 7), ("yz", 7))
    values = [-2, -1, -0.5, -0.0, 0, 0.5, 1, 2]
    grids = [rng.choice(values, size=(T, 2)) for T in tables]
    h, saved = hash_grid.forward(x_a, lo, hi, grids, resolutions)
    h_bar = rng.normal(size=h.shape)
    gradients = hash_grid.backward(saved, h_bar)["grids"]
    wanted = [np.zeros_like(grid) for grid in grids]
    for a, x in enumerate(x_a):
        for level, ((axes, res), grid) in enumerate(zip(resolutions, grids)):
            corners = slow_nodes(x, lo, hi, axes, res, len(grid))
            assert sum(corners.values()) == pytest.approx(1, rel=1e-15)
            columns = slice(2 * level, 2 * level + 2)
            read = sum(w * np.where(grid[i] >= 0, 1, -1) for i, w in corners.items())
            assert h[a, columns] == pytest.approx(read, abs=1e-14)
            for i, w in corners.items():
                wanted[level][i] += w * h_bar[a, columns] * (np.abs(grid[i]) <= 1)
    for got, want in zip(gradients, wanted):
        assert np.abs(got - want).max() <= 1e-13 and np.any(want)


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


def test_prior_layout_group_by_group():
    widths, outputs = (2, 3, 3, 6), np.arange(28.0) / 10
    (mu, sigma), _ = prior.forward(np.zeros((1, 1)), [np.zeros((1, 28))], [outputs], widths)
    wanted_mu, wanted_raw, start = [], [], 0
    for width in widths:
        wanted_mu += list(outputs[start : start + width])
        wanted_raw += list(outputs[start + width : start + 2 * width])
        start += 2 * width
    assert np.array_equal(mu, [wanted_mu])
    assert sigma[0] == pytest.approx(np.exp(wanted_raw), rel=1e-15)


# --- Eqs. (13) and (14) --------------------------------------------------------------------------


@BOTH
def test_anchor_rate_against_an_exact_sum(dtype):
    rng = np.random.default_rng(5)
    A, k, d = 20001, 5, 7
    shapes = {"bits_f": (A, d), "bits_s": (A, 3), "bits_l": (A, 3), "bits_O": (A, k, 3)}
    bits = {
        name: rng.lognormal(sigma=4, size=shape).astype(dtype) for name, shape in shapes.items()
    }
    mask = rng.random((A, k)) < 0.6
    counted = [bits["bits_f"], bits["bits_s"], bits["bits_l"], bits["bits_O"][mask]]
    want = math.fsum(np.concatenate([group.ravel() for group in counted]).tolist())
    R_anchor, _ = anchor_rate.forward(**bits, mask=mask)
    assert R_anchor.dtype == dtype
    relative = 1e-14 if dtype == np.float64 else 2.0**-24
    assert float(R_anchor) == pytest.approx(want, rel=relative)


@BOTH
@pytest.mark.parametrize("p", [0.5, 0.03, 0.999])
def test_hash_rate_against_the_entropy_of_its_signs(p, dtype):
    rng = np.random.default_rng(10)
    grids = [np.where(rng.random((T, 2)) < p, 0.25, -0.5).astype(dtype) for T in (512, 256, 7)]
    signs = np.concatenate([grid.ravel() for grid in grids]) > 0
    counts = int(signs.sum()), int((~signs).sum())
    want = math.fsum(-math.log2(counts[0 if sign else 1] / signs.size) for sign in signs)
    (R_hash, n_pos, n_neg), saved = hash_rate.forward(grids)
    assert R_hash == pytest.approx(want, rel=1e-12 if dtype == np.float64 else 1e-7)
    assert (n_pos, n_neg) == counts and R_hash.dtype == dtype
    # One more -1 in the place of a +1 changes R_hash by about -2 slopes.
    more = hash_rate.entropy(n_pos + 0.5, n_neg - 0.5)
    fewer = hash_rate.entropy(n_pos - 0.5, n_neg + 0.5)
    slope = hash_rate.backward(saved, 1.0)["grids"][0][0, 0]
    assert -2 * slope == pytest.approx(fewer - more, rel=2e-2, abs=2e-2)


@BOTH
@pytest.mark.parametrize("rows, sign", [(None, 1), (0, 1), (5, 1), (5, -1)])
def test_hash_rate_of_agreeing_signs(dtype, rows, sign):
    grids = [] if rows is None else [np.full((rows, 2), sign, dtype)]
    (R_hash, _, _), saved = hash_rate.forward(grids)
    assert R_hash == 0
    assert not any(grid.any() for grid in hash_rate.backward(saved, dtype(3))["grids"])
