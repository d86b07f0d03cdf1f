"""Vectors of level L0, the half of coding: grid cells and hashes, steps, deviations, ties, bins."""

import math

import numpy as np

from p4dgs_ref.equations.grid_nodes import entries, nodes
from p4dgs_ref.table import EQUATIONS
from tests.golden.cases import Case
from tests.golden.flat import as_published
from tests.golden.scalars import identity
from tests.golden.subjects import no_pullback

PHI_0 = 1 / math.sqrt(2 * math.pi)


# --- the hash grid ------------------------------------------------------------------------------
def cell_vjp(x, lo, hi, res):
    """The two nodes around a coordinate and their weights (Q11).

    Beyond the box its face counts. u = 0 where hi = lo. On the last node both nodes are that one.
    """
    first = np.array([1, 0, 0], x.dtype)
    node, weight = nodes(x[:, None] * first, lo * first, hi * first, "x", res, res)
    return {"node": node, "weight": weight}, no_pullback


def cell_cases():
    box = dict(lo=np.float64(-1.0), hi=np.float64(3.0))
    flat = dict(lo=np.float64(0.5), hi=np.float64(0.5))
    return [
        Case("ordinary", dict(x=np.array([-0.9, -0.13, 0.77, 2.9, 1.6]), **box, res=7)),
        Case(
            "on_nodes",
            dict(x=np.arange(-1.0, 4), **box, res=5),
            ("kink", "zero"),
            smooth=False,
            expected={
                "node": np.array([[0, 1], [1, 2], [2, 3], [3, 4], [4, 4]]),
                "weight": np.tile([1.0, 0], (5, 1)),
            },
        ),
        Case(
            "outside",
            dict(x=np.array([-1.5, -1e30, 3.5, 1e30]), **box, res=5),
            ("outside", "clamped", "extreme"),
            smooth=False,
            expected={
                "node": np.array([[0, 1], [0, 1], [4, 4], [4, 4]]),
                "weight": np.tile([1.0, 0], (4, 1)),
            },
        ),
        Case(
            "no_extent",
            dict(x=np.array([0.5, 0.4, 7.0]), **flat, res=5),
            ("zero", "outside"),
            smooth=False,
            expected={"node": np.tile([0, 1], (3, 1)), "weight": np.tile([1.0, 0], (3, 1))},
        ),
        Case(
            "one_node",
            dict(x=np.array([-0.9, 3.0]), **box, res=1),
            ("single",),
            smooth=False,
            expected={"node": np.zeros((2, 2), int), "weight": np.tile([1.0, 0], (2, 1))},
        ),
    ]


def row_vjp(corner, res, table):
    """The row of a level's array that a corner (n, D) of a cell reads (Q11).

    It is i + j res + k res^2 if res^D <= table, else
    (i XOR 2654435761 j XOR 805459861 k) mod 2^32 mod table.
    """
    origin = np.zeros((1, corner.shape[1]), np.int64)
    return {"row": entries(corner, origin, res, table)[:, 0]}, no_pullback


def row_cases():
    rng = np.random.default_rng(102)
    # A table of 6007 rows needs all 32 bits, and a signed number would be negative.
    paper = np.concatenate([rng.integers(0, 514, (8, 3)), [[513, 513, 513], [0, 513, 1]]])
    plane = np.concatenate([rng.integers(0, 1026, (7, 2)), [[1025, 1025]]])
    # Products beyond 2^53, which a double does not hold.
    beyond = rng.integers(2**23, 2**24, (9, 3))
    return [
        Case(
            "dense",
            dict(
                corner=np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 4], [1, 2, 3], [4, 4, 4]]),
                res=5,
                table=125,
            ),
            expected={"row": np.array([0, 4, 20, 100, 86, 124])},
        ),
        Case(
            "dense_plane",
            dict(corner=np.array([[0, 0], [6, 1], [1, 6], [6, 6]]), res=7, table=60),
            expected={"row": np.array([0, 13, 43, 48])},
        ),
        # 2654435761 = 0x9E3779B1 and 805459861 = 0x30025795; their last 13 bits are 0x19B1 and
        # 0x1795, and the XOR of those is 0xE24.
        Case(
            "primes",
            dict(
                corner=np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]]), res=24, table=2**13
            ),
            expected={"row": np.array([1, 0x19B1, 0x1795, 0xE24])},
        ),
        Case("paper_3d", dict(corner=paper, res=514, table=2**13), ("extreme",)),
        Case("table_of_no_power_of_two", dict(corner=paper, res=514, table=6007), ("extreme",)),
        Case("paper_2d", dict(corner=plane, res=1026, table=2**15), ("extreme",)),
        Case(
            "products_beyond_doubles",
            dict(corner=beyond, res=2**24, table=2**15 - 19),
            ("extreme",),
        ),
    ]


# --- what follows psi_q and psi_p ---------------------------------------------------------------
def step_vjp(u, Q_0):
    """The step of a network's output u; its floor 2^-10 Q_0 is reached at u = -3.8121 (Q7)."""
    outputs, pullback = EQUATIONS["step"].vjp(h=u, **identity(u), Q_0=Q_0)
    return outputs, lambda **bars: {"u": pullback(**bars)["h"]}


def step_cases():
    Q_0 = np.array([1.0, 0.001, 0.2])
    near_floor = np.array([[-3.80, -3.81, -3.82], [-3.83, -3.805, -3.815]])
    floored = np.array(
        [[-5.0, -10, -19], [-44, -100, -1e4]]
    )  # 1 + tanh is exactly 0 from -19.07 on
    return [
        Case("ordinary", dict(u=np.array([[0.0, 0.3, -0.4], [1.1, -1.2, 2.0]]), Q_0=Q_0)),
        Case("beside_the_floor", dict(u=near_floor, Q_0=Q_0), ("clamped",)),
        Case(
            "on_the_floor",
            dict(u=floored, Q_0=Q_0),
            ("clamped", "saturated"),
            smooth=False,
            cotangents={"q_bar": np.array([[2.0, -3, 5], [-7, 11, 13]])},
            expected={"q": np.tile(Q_0 / 1024, (2, 1)), "u_bar": np.zeros((2, 3))},
        ),
        Case(
            "large",
            dict(u=np.array([[5.0, 12, 20], [44, 100, 1e4]]), Q_0=Q_0),
            ("saturated", "extreme"),
        ),
    ]


def sigma_vjp(raw):
    """The deviation of a network's raw output, its logarithm clamped to [-14, 6] (Q8)."""
    eye, width = np.eye(raw.shape[1], dtype=raw.dtype), raw.shape[1]
    outputs, pullback = EQUATIONS["prior"].vjp(
        h=raw,
        weights=[np.concatenate([0 * eye, eye], axis=1)],  # mu = 0
        biases=[np.zeros(2 * width, raw.dtype)],
        widths=(width,),
    )
    return {"sigma": outputs["sigma"]}, lambda **bars: {"raw": pullback(**bars)["h"]}


def sigma_cases():
    raw, bar = (
        np.array([[-14.0, -14.5], [6.0, 6.5], [-1e4, 1e4]]),
        np.array([[2.0, -3], [5, 7], [-11, 13]]),
    )
    sigma = np.exp(np.array([[-14.0, -14], [6, 6], [-14, 6]]))
    return [
        Case("ordinary", dict(raw=np.array([[0.0, -1.5, 2.3], [-7.1, 4.4, -13.9]]))),
        Case(
            "clamped",
            dict(raw=raw),
            ("clamped", "kink"),
            smooth=False,
            cotangents={"sigma_bar": bar},
            expected={"sigma": sigma, "raw_bar": bar * sigma * [[1, 0], [1, 0], [0, 0]]},
        ),
    ]


# --- ties and bins ------------------------------------------------------------------------------
def ties_cases():
    half = np.array([[-2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5]])
    even = np.array([[-2, -2, 0, 0, 2, 2, 4]])
    for name, q in (("ordinary", 1.0), ("power_of_two", 2.0**-9)):
        yield Case(
            name,
            dict(f=half * q, q=np.array([[q]])),
            ("tie",),
            expected={"symbols": even, "f_hat": even * q},
        )
    up, down = np.nextafter(half, np.inf), np.nextafter(half, -np.inf)
    yield Case(
        "beside",
        dict(f=np.concatenate([up, down]), q=np.ones((2, 1))),
        ("tie",),
        expected={"symbols": np.array([[-2, -1, 0, 1, 2, 3, 4], [-3, -2, -1, 0, 1, 2, 3]])},
    )
    # No decimal here is exact: the quotients of 0.15 and 0.35 are below the tie, the others are
    # rounded to it.
    decimal = dict(f=np.array([[0.05, 0.15, 0.25, 0.35, 0.45, -0.25]]), q=np.array([[0.1]]))
    yield Case("decimal", decimal, ("tie",), expected={"symbols": np.array([[0, 1, 2, 3, 4, -2]])})
    yield Case(
        "zeros",
        dict(f=np.array([[0.0, -0.0, 1e-300, -1e-300]]), q=np.array([[0.25]])),
        ("zero", "negative"),
        expected={"symbols": np.zeros((1, 4), int), "f_hat": np.zeros((1, 4))},
    )


def bin_vjp(z, w):
    """Log mass of a standard Gaussian in [z - w/2, z + w/2] in nats, and its slopes in z and w.

    For |z| <= 1000 and 1e-12 <= w <= 1e6, without a floor under the mass.
    """
    one = np.ones((len(z), 1), z.dtype)
    outputs, pullback = EQUATIONS["likelihood"].vjp(
        f_noisy=z[:, None], mu=0 * one, sigma=one, q=w[:, None]
    )
    slopes = pullback(bits_bar=one)
    tensors = {"log_p": outputs["bits"], "slope_z": slopes["f_noisy"], "slope_w": slopes["q"]}
    nats = z.dtype.type(-math.log(2))
    return {name: nats * a[:, 0] for name, a in tensors.items()}, no_pullback


def bin_cases():
    def case(name, z, w, *flags, **expected):
        z, w = np.broadcast_arrays(np.array(z, float), np.array(w, float))
        return Case(name, dict(z=z.copy(), w=w.copy()), flags, expected=expected)

    def both(*z):
        return np.array([sign * v for v in z for sign in (1, -1)])

    yield case("ordinary", [0.3, -1.1, 2.4, -0.7, 3.9], [0.5, 1.0, 0.2, 3.0, 1.5], "ordinary")
    for name, w, *flag in (
        ("tails", 1.0),
        ("tails_of_fine_bins", 0.01),
        ("tails_of_narrow_bins", 1e-4, "narrow"),
    ):
        yield case(
            name, both(1, 3, 5.5, 6, 9, 12, 20, 37.5, 40, 200, 1000), w, "tail", "negative", *flag
        )
    yield case(
        "narrow", [0, 0.5, -1, 3, -6] * 4, np.repeat([1e-12, 1e-9, 1e-6, 1e-3], 5), "narrow", "zero"
    )
    yield case(
        "wide",
        [0, 0.5, -3, 10],
        1e6,
        "wide",
        log_p=np.zeros(4),
        slope_z=np.zeros(4),
        slope_w=np.zeros(4),
    )
    yield case(
        "edges_of_wide_bins",
        [50, -50, 49, 52, 5e5, -5e5],
        [100] * 4 + [1e6] * 2,
        "wide",
        "negative",
        "tail",
    )
    # On either side of where this project changes formulas: w = 1/16, z w = 1/16, lower edge at 2.
    above, below = 1 + 1e-9, 1 - 1e-9
    yield case(
        "regimes",
        [0.4, 0.4, 4, 4, 2.5, 2.5],
        [above / 16, below / 16, above / 64, below / 64, above, below],
        "narrow",
        "tail",
    )
    p, phi = math.erf(0.5 / math.sqrt(2)), PHI_0 * math.exp(-1 / 8)  # one bin of width 1 about 0
    yield case(
        "centred",
        [0],
        1,
        "zero",
        "single",
        log_p=np.array([math.log(p)]),
        slope_z=np.zeros(1),
        slope_w=np.array([phi / p]),
    )


SUBJECTS = (
    as_published("grid_cell", cell_vjp, cell_cases),
    as_published("hash_index", row_vjp, row_cases),
    as_published("step_floor", step_vjp, step_cases),
    as_published("sigma_clamp", sigma_vjp, sigma_cases),
    as_published("rounding_ties", EQUATIONS["rounding"].vjp, ties_cases),
    as_published("gaussian_bin", bin_vjp, bin_cases),
)
