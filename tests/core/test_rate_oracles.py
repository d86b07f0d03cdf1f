"""Eqs. (8) to (14) against stored high-precision constants, exact rationals and slow twins."""

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from p4dgs_ref.equations import (
    anchor_rate,
    gaussian_bin,
    grid_nodes,
    hash_grid,
    hash_rate,
    likelihood,
    noise,
    prior,
    rounding,
    step,
)

TABLE = json.loads(
    (Path(__file__).parents[1] / "golden" / "data" / "gaussian_bin_constants.json").read_text()
)
Z, W, BITS, BITS_X, BITS_Q = (np.array(column)[None] for column in zip(*TABLE["rows"]))
EPS = 2.0**-52
BOTH = pytest.mark.parametrize("dtype", [np.float64, np.float32])
SIGNS = pytest.mark.parametrize("sign", [1, -1])

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def rate(z, w, mu=0.0, sigma=1.0, dtype=np.float64, rung=likelihood.forward):
    """Bits, and their derivatives by f_noisy, mu, sigma and q, in units of 1 / sigma."""
    z, w = np.broadcast_arrays(np.asarray(z, float), w)
    out, res = rung(
        *(a.astype(dtype) for a in (mu + sigma * z, mu + 0 * z, sigma + 0 * z, sigma * w))
    )
    return out.bits, {
        name: sigma * g for name, g in likelihood.backward(res, np.ones_like(out.bits)).items()
    }


# --- Eq. (11): values and gradients ------------------------------------------------------------------------------
def allowed(bits, relative):
    """Relative error granted to bits: `relative` above a millionth, and always 4 ulp times the condition number."""
    condition = (np.abs(Z * BITS_X) + np.abs(W * BITS_Q)) / np.maximum(bits, 1e-300)
    return np.maximum(np.where(bits > 1e-6, relative, 0), 4 * EPS * (1 + condition)) * bits + 1e-300


def check_bits_and_slopes(bits, g, sign, relative, slope_error, rows=slice(None)):
    assert np.all(np.abs(bits - BITS)[0, rows] <= allowed(BITS, relative)[0, rows])
    ratio = 2 * np.abs(BITS_Q)  # at least the larger density ratio of the two edges
    for got, want, largest in (
        (g["f_noisy"], sign * BITS_X, ratio),
        (g["mu"], -sign * BITS_X, ratio),
        (g["q"], BITS_Q, ratio),
        (g["sigma"], -(Z * BITS_X + W * BITS_Q), (Z + W) * ratio),
    ):
        assert np.all(np.abs(got - want)[0, rows] <= slope_error * largest[0, rows] + 1e-300)


def test_the_table_covers_every_regime():
    narrow = np.maximum(W, Z * W) < gaussian_bin.NARROW
    low = Z - W / 2
    for regime in (
        narrow & (low > 8),
        narrow & (low < 0),
        ~narrow & (low > gaussian_bin.FAR),
        ~narrow & (low < 0),
        ~narrow & (low > 0) & (low < gaussian_bin.FAR),
        (BITS < 1e-6) & (BITS > 0),
        BITS == 0,
    ):
        assert regime.sum() >= 8
    assert Z.max() == 1000 and W.max() == 1e6 and W.min() == 1e-12


@SIGNS
def test_likelihood_against_constants(sign):
    check_bits_and_slopes(*rate(sign * Z, W), sign, 1e-12, 1e-12)


@SIGNS
@pytest.mark.parametrize(
    "sigma", [2.0**-30, 2.0**-13, 2.0**20]
)  # about 1e-9, 1e-4, 1e6: exact to scale by
def test_likelihood_scales_with_sigma(sign, sigma):
    check_bits_and_slopes(*rate(sign * Z, W, sigma=sigma), sign, 1e-12, 1e-12)


@SIGNS
def test_likelihood_depends_on_the_distance_to_mu(sign):
    exact = Z[0] % 0.5 == 0  # then z + 8 is exact
    assert exact.sum() > 100
    check_bits_and_slopes(*rate(sign * Z, W, mu=8.0), sign, 1e-12, 1e-12, exact)


@SIGNS
def test_likelihood_in_float32(sign):
    exact = ((Z.astype(np.float32) == Z) & (W.astype(np.float32) == W))[0]
    assert exact.sum() >= 40
    bits, g = rate(sign * Z, W, dtype=np.float32)
    assert bits.dtype == np.float32 and all(a.dtype == np.float32 for a in g.values())
    check_bits_and_slopes(bits, g, sign, 2e-6, 2e-6, exact & (BITS[0] > 1e-6))
    # Rows that float32 must round first: the same rounded numbers in float64 are right by the tests above.
    z, w = (a.astype(np.float32).astype(float) for a in (Z, W))
    wanted, _ = rate(sign * z, w)
    assert np.all(np.abs(bits - wanted) <= 2e-6 * wanted + 1e-37)


def test_far_outliers_are_pulled_back():
    z = np.array([[6.0, 9, 20, 40, 1000, 1e6]])
    for w in (1e-12, 1e-4, 1.0, 3.0):
        (up, g_up), (down, g_down) = rate(z, w), rate(-z, w)
        assert np.isfinite(up).all() and np.array_equal(up, down)  # even
        assert np.array_equal(g_up["f_noisy"], -g_down["f_noisy"])  # odd
        assert np.all(g_up["f_noisy"] > 0) and np.array_equal(g_up["mu"], -g_up["f_noisy"])
        assert np.abs(g_up["f_noisy"] * math.log(2) / z - 1).max() < 0.4  # grows about linearly
        assert np.all(np.diff(up) > 0)


def test_regimes_meet():
    """Values and slopes do not jump where one formula hands over to another."""
    places = [
        (z, gaussian_bin.NARROW / max(1, z)) for z in (0, 0.5, 1, 2, 8, 30, 1000)
    ]  # narrow | difference
    places += [(w / 2, w) for w in (0.05, 1, 10, 100)]  # inside | outside
    places += [(gaussian_bin.FAR + w / 2, w) for w in (0.05, 1, 10, 1e3)]  # difference | far
    for z, w in places:
        near = 1 + 1e-13 * np.array([[-1, 1, -1, 1, 0], [-1, -1, 1, 1, 0]])
        bits, g = rate(z * near[:1], w * near[1:])
        for values, scale in (
            (bits, 0),
            *((slope, (1 + z + w) * np.abs(g["q"]).max()) for slope in g.values()),
        ):
            assert np.ptp(values) <= 1e-9 * max(np.abs(values).max(), scale) + 1e-15, (z, w)


def test_masses_of_all_bins_add_up_to_one():
    for mu, sigma in ((0.3, 0.2), (-1.7, 4.0), (0.5, 60.0)):
        k = np.arange(-700.0, 701)[None]
        bits, _ = rate((k - mu) / sigma, 1 / sigma)
        assert math.fsum(2.0 ** -bits[0]) == pytest.approx(1, abs=1e-13)


def test_regimes_side_by_side_and_any_memory_order():
    """Every row of the table alone, in one array and in a transposed one: the same bits."""
    together, _ = rate(Z, W)
    alone = [rate(Z[:, [i]], W[:, [i]])[0][0, 0] for i in range(Z.size)]
    across = rate(Z.reshape(2, -1).T, W.reshape(2, -1).T)[0].T
    assert np.array_equal(together[0], alone) and np.array_equal(together, across.reshape(1, -1))


def test_rungs_fail_where_the_literature_says():
    literal, _ = rate([[4.0, 9.0]], 1.0, rung=likelihood.literal)
    assert literal[0, 0] == pytest.approx(12.0909, abs=1e-4) and literal[0, 1] == np.inf
    assert rate([[6.0]], 1.0, dtype=np.float32, rung=likelihood.literal)[0] == np.inf
    bits, g = rate([[4.0, 5.5, 9.0]], 1.0, rung=likelihood.hac)
    assert bits[0] == pytest.approx([12.0909, 19.9316, 19.9316], abs=1e-4)
    assert g["f_noisy"][0, 0] > 5 and not any(
        a[0, 1:].any() for a in g.values()
    )  # never pulled back


# --- Eq. (7) -----------------------------------------------------------------------------------------------------
def test_noise_has_the_deviation_of_a_rounding_error():
    rng = np.random.default_rng(1)
    q = np.array([[0.5], [3.0]])
    f_noisy = noise.forward(np.zeros((2, 40000)), rng.uniform(-0.5, 0.5, size=(2, 40000)), q)[
        0
    ].f_noisy
    assert f_noisy.std(axis=1) == pytest.approx(q[:, 0] / math.sqrt(12), rel=0.01)
    assert np.all(np.abs(f_noisy) <= q / 2)


# --- Eq. (8) -----------------------------------------------------------------------------------------------------
@BOTH
def test_steps(dtype):
    u = [-1e4, -100, -19, -10, -3.9, -3, -0.5, 0, 0.5, 3, 19, 100, 1e4]
    # h = u and unit weights: psi_q is u in every group
    out, res = step.forward(
        np.array(u, dtype)[:, None],
        [np.ones((1, 4), dtype)],
        [np.zeros(4, dtype)],
        np.array([0.5, 0.01, 0.01, 0.1], dtype),
    )
    rows_bar = np.random.default_rng(2).normal(size=out.q.shape).astype(dtype)
    h_bar = step.backward(res, rows_bar)["h"]
    for v, q, q_bar, slope in zip(u, out.q, rows_bar, h_bar[:, 0]):
        factor = 2 / (1 + math.exp(min(-2 * v, 700.0)))
        for got, Q_0 in zip(q, (0.5, 0.01, 0.01, 0.1)):
            assert (
                got
                == pytest.approx(max(factor, 2.0**-10) * Q_0, rel=10 * float(np.finfo(dtype).eps))
                and got > 0
            )
        want = (
            4 / (math.exp(min(v, 350.0)) + math.exp(min(-v, 350.0))) ** 2
            if factor > 2.0**-10
            else 0.0
        )
        scale = sum(abs(float(b)) * Q_0 for b, Q_0 in zip(q_bar, (0.5, 0.01, 0.01, 0.1)))
        signed = sum(float(b) * Q_0 for b, Q_0 in zip(q_bar, (0.5, 0.01, 0.01, 0.1)))
        assert abs(slope - want * signed) <= 20 * np.finfo(dtype).eps * want * scale + 1e-38
    assert np.isfinite(h_bar).all() and out.q.dtype == h_bar.dtype == dtype


# --- Eq. (9) -----------------------------------------------------------------------------------------------------
def test_hash_of_a_known_node():
    """Node (1, 1, 1) is 1 ^ 2654435761 ^ 805459861 = 2922720805, modulo 8192 = 3621."""
    x = np.full((1, 3), 0.5)
    index, weight = grid_nodes.nodes(x, np.zeros(3), np.full(3, 32.0), "xyz", 33, 8192)
    assert index.dtype == np.int64 and index[0, -1] == 3621 and index[0, 0] == 0
    assert np.array_equal(weight, np.full((1, 8), 0.125))


def slow_nodes(x, lo, hi, axes, res, table):
    """Corner by corner in exact integers: {entry: weight}."""
    found, places = {}, []
    for name in axes:
        i = "xyz".index(name)
        u = (x[i] - lo[i]) / (hi[i] - lo[i]) if hi[i] > lo[i] else 0.0
        places.append(min(max(u, 0.0), 1.0) * (res - 1))
    for corner in range(2 ** len(axes)):
        ups = [corner >> j & 1 for j in range(len(axes))]
        entry = [min(int(place) + up, res - 1) for place, up in zip(places, ups)]
        weight = math.prod(place % 1 if up else 1 - place % 1 for place, up in zip(places, ups))
        index = sum(c * res**j for j, c in enumerate(entry))
        if res ** len(axes) > table:
            x, y, *z = (c * prime % 2**32 for c, prime in zip(entry, (1, 2654435761, 805459861)))
            index = (x ^ y ^ sum(z)) % table
        found[index] = found.get(index, 0.0) + weight
    return found


@pytest.mark.parametrize("tables", [(125, 49, 49, 49), (16, 8, 1, 49), (8192, 10, 48, 50)])
def test_hash_grid_against_a_loop(tables):
    rng = np.random.default_rng(3)
    lo, hi = np.array([-1.0, 2, -3]), np.array([1.0, 2, 4])  # no extent along y
    x_a = np.concatenate(
        [rng.uniform(-5, 5, size=(30, 3)), [lo, hi, (lo + hi) / 2], lo + [[0.5, 0, 1.75]]]
    )
    resolutions = (("xyz", 5), ("xy", 7), ("xz", 7), ("yz", 7))
    grids = [rng.choice([-2, -1, -0.5, -0.0, 0, 0.5, 1, 2], size=(T, 2)) for T in tables]
    out, res = hash_grid.forward(x_a, lo, hi, grids, resolutions)
    h_bar = rng.normal(size=out.h.shape)
    gradients = hash_grid.backward(res, h_bar)["grids"]
    wanted = [np.zeros_like(grid) for grid in grids]
    for a, x in enumerate(x_a):
        for level, ((axes, r), grid) in enumerate(zip(resolutions, grids)):
            for F in range(2):
                corners = slow_nodes(x, lo, hi, axes, r, len(grid))
                assert sum(corners.values()) == pytest.approx(1, rel=1e-15)
                value = sum(w * (1 if grid[i, F] >= 0 else -1) for i, w in corners.items())
                assert out.h[a, 2 * level + F] == pytest.approx(value, abs=1e-14)
                for i, w in corners.items():
                    wanted[level][i, F] += w * h_bar[a, 2 * level + F] * (abs(grid[i, F]) <= 1)
    for got, want in zip(gradients, wanted):
        assert np.abs(got - want).max() <= 1e-13 and np.any(want)


def test_levels_must_match():
    with pytest.raises(ValueError):
        hash_grid.forward(
            np.zeros((1, 3)), np.zeros(3), np.ones(3), [np.ones((4, 1))], (("xy", 2), ("xz", 2))
        )
    with pytest.raises(ValueError):
        grid_nodes.nodes(np.zeros((1, 3)), np.zeros(3), np.ones(3), "xw", 2, 4)


# --- Eq. (10) ----------------------------------------------------------------------------------------------------
@BOTH
def test_rounding_against_exact_rationals(dtype):
    rng = np.random.default_rng(4)
    q = rng.uniform(0.01, 3, size=(400, 1)).astype(dtype)
    f = (q * rng.normal(scale=50, size=(400, 5))).astype(dtype)
    if dtype == np.float32:  # the quotient in float32 would call many of these a tie
        f[:, :4] = ((rng.integers(-9, 9, size=(400, 4)) + 0.5) * q).astype(dtype)
        assert np.sum(np.rint(f / q) != rounding.forward(f, q)[0].symbols) > 100
    out, _ = rounding.forward(f, q)
    for row, s, (k, *ks) in zip(f, q, out.symbols.tolist()):
        assert [k, *ks] == [round(Fraction(float(v)) / Fraction(float(s[0]))) for v in row]
    assert out.symbols.dtype == np.int64 and out.f_hat.dtype == dtype
    assert np.array_equal(out.f_hat, (out.symbols * q.astype(float)).astype(dtype))
    assert np.all(np.abs(out.f_hat - f) <= q * (0.5 + 100 * np.finfo(dtype).eps))


@BOTH
def test_rounding_has_one_zero(dtype):
    out, _ = rounding.forward(np.array([[-0.0, -0.4, -0.5]], dtype), np.ones((1, 1), dtype))
    assert not out.symbols.any() and not np.signbit(out.f_hat).any()


@BOTH
@pytest.mark.parametrize(
    "value, q", [(2.0**31, 1), (-(2.0**31), 1), (np.nan, 1), (np.inf, 1), (1, 0), (0, 0)]
)
def test_rounding_names_what_does_not_fit(dtype, value, q):
    f, steps = np.ones((4, 3), dtype), np.ones((4, 1), dtype)
    f[2, 1], steps[2] = value, q
    f[2, 2] = f[2, 0] = 0 if q else 1
    with pytest.raises(OverflowError, match=r"f\[2, 0\]" if q == 0 else r"f\[2, 1\]"):
        rounding.forward(f, steps)


# --- Eq. (12) ----------------------------------------------------------------------------------------------------
def test_prior_layout_group_by_group():
    widths, y = (2, 3, 3, 6), np.arange(28.0) / 10
    out, _ = prior.forward(np.zeros((1, 1)), [np.zeros((1, 28))], [y], widths)
    mu, raw, start = [], [], 0
    for width in widths:
        mu += list(y[start : start + width])
        raw += list(y[start + width : start + 2 * width])
        start += 2 * width
    assert np.array_equal(out.mu, [mu]) and out.sigma[0] == pytest.approx(np.exp(raw), rel=1e-15)


# --- Eqs. (13), (14) ---------------------------------------------------------------------------------------------
@BOTH
def test_anchor_rate_against_an_exact_sum(dtype):
    rng = np.random.default_rng(5)
    A, k, d = 20001, 5, 7
    f, O, l, s = (
        rng.lognormal(sigma=4, size=shape).astype(dtype)
        for shape in ((A, d), (A, k, 3), (A, 3), (A, 3))
    )
    mask = rng.random((A, k)) < 0.6
    want = math.fsum(
        [*f.ravel().tolist(), *O[mask].ravel().tolist(), *l.ravel().tolist(), *s.ravel().tolist()]
    )
    out, _ = anchor_rate.forward(f, O, l, s, mask)
    assert out.R_anchor.dtype == dtype
    assert float(out.R_anchor) == pytest.approx(
        want, rel=1e-14 if dtype == np.float64 else 2.0**-24
    )


@BOTH
def test_hash_rate_against_the_entropy_of_its_signs(dtype):
    rng = np.random.default_rng(6)
    for p in (0.5, 0.03, 0.999):
        grids = [
            np.where(rng.random(shape) < p, 0.25, -0.5).astype(dtype)
            for shape in ((512, 2), (256, 2), (7, 2))
        ]
        signs = np.concatenate([grid.ravel() for grid in grids]) > 0
        n_pos, n_neg = int(signs.sum()), int((~signs).sum())
        bits = math.fsum(-math.log2((n_pos if sign else n_neg) / signs.size) for sign in signs)
        out, res = hash_rate.forward(grids)
        assert out.R_hash == pytest.approx(bits, rel=1e-12 if dtype == np.float64 else 1e-7)
        assert (out.n_pos, out.n_neg) == (n_pos, n_neg) and out.R_hash.dtype == dtype
        # one more -1 in place of a +1 changes R_hash by about -2 slopes
        flipped = hash_rate.entropy(n_pos - 0.5, n_neg + 0.5) - hash_rate.entropy(
            n_pos + 0.5, n_neg - 0.5
        )
        slope = hash_rate.backward(res, 1.0)["grids"][0][0, 0]
        assert -2 * slope == pytest.approx(flipped, rel=2e-2, abs=2e-2)


@BOTH
def test_hash_rate_of_agreeing_signs(dtype):
    for grids in (
        [],
        [np.zeros((0, 2), dtype)],
        [np.ones((5, 2), dtype)],
        [-np.ones((5, 2), dtype)],
    ):
        out, res = hash_rate.forward(grids)
        assert out.R_hash == 0 and not any(
            grid.any() for grid in hash_rate.backward(res, dtype(3))["grids"]
        )
