"""Known mistakes in Eqs. (9) and (14): reading the binary hash grid, and pricing it."""

import math

import numpy as np

from p4dgs_ref.equations.grid_nodes import PRIMES
from tests.golden.mistakes.kit import NotApplicable, bars_of, known, surgery


# --- Eq. (9): a reader whose every step can be another one --------------------------------------
def u_of(x_a, lo, hi, axis):
    extent = (hi - lo)[axis]
    u = np.divide(
        (x_a - lo)[:, axis],
        extent,
        out=np.zeros((len(x_a), len(axis)), x_a.dtype),
        where=extent > 0,
    )
    return np.clip(u, 0, 1)


def on_nodes(u, res):
    return u * (res - 1)


def dense_or(hashed):
    """The rows of corners (A, 2^D, D): dense where the table holds all, else hashed."""

    def row(corner, res, table):
        D = corner.shape[2]
        return corner @ res ** np.arange(D) if res**D <= table else hashed(corner, table)

    return row


def wrapped(corner, primes=PRIMES):
    return corner.astype(np.uint32) * primes[: corner.shape[2]]


def xor(corner, table):
    return (np.bitwise_xor.reduce(wrapped(corner), axis=2) % np.uint32(table)).astype(np.int64)


def binary(parameter):
    return np.where(parameter >= 0, 1, -1)


def reading(position=on_nodes, row=dense_or(xor), sign=binary, zeros_outside=False):
    """`run` of a port with another position(u, res), row(corner, res, table) or sign(parameter).

    Corners outside the grid are those on its border or, if `zeros_outside`, count as zero.
    """

    def run(given, cotangents):
        x_a, grids = given["x_a"], given["grids"]
        F, bar = grids[0].shape[1], bars_of(cotangents)["h"]
        levels, grids_bar = [], []
        for i, ((axes, res), grid) in enumerate(zip(given["resolutions"], grids)):
            place = position(
                u_of(x_a, given["lo"], given["hi"], ["xyz".index(a) for a in axes]), res
            )
            base = np.floor(place)
            corners = np.indices((2,) * len(axes)).reshape(len(axes), -1).T
            weight = np.where(corners, (place - base)[:, None], 1 - (place - base)[:, None]).prod(
                axis=2
            )
            nodes = base.astype(np.int64)[:, None] + corners
            if zeros_outside:
                weight = weight * ((nodes >= 0) & (nodes < res)).all(axis=2)
            rows = row(np.clip(nodes, 0, res - 1), res, len(grid))
            levels.append(np.einsum("nc,ncf->nf", weight, sign(grid).astype(grid.dtype)[rows]))
            entries_bar = np.zeros_like(grid)
            np.add.at(entries_bar, rows, weight[:, :, None] * bar[:, None, i * F : (i + 1) * F])
            grids_bar.append(entries_bar * (np.abs(grid) <= 1))
        return {"h": np.concatenate(levels, axis=1)}, {"grids": grids_bar}

    return run


def cells(u, res):
    """Nodes at the centres of res cells."""
    return np.clip(u * res - 0.5, 0, res - 1)


def half_cell_up(u, res):
    """Half a cell above the node, as in instant-ngp."""
    return u * (res - 1) + 0.5


def half_cell_inside(u, res):
    """From half a cell inside the lower face to half a cell inside the upper one, as in HAC."""
    return u * (res - 2) + 0.5


def mirrored(u, res):
    """What one corner weighs goes to its opposite."""
    base = np.floor(u * (res - 1))
    return np.minimum(2 * base + 1 - u * (res - 1), res - 1)


def z_fastest(corner, res, table):
    D = corner.shape[2]
    return corner @ res ** np.arange(D)[::-1] if res**D <= table else xor(corner, table)


def always_hashed(corner, res, table):
    return xor(corner, table)


def modulo_first(corner, table):
    parts = wrapped(corner) % np.uint32(table)
    return (np.bitwise_xor.reduce(parts, axis=2) % np.uint32(table)).astype(np.int64)


def other_primes(corner, table):
    swapped = wrapped(corner, PRIMES[[0, 2, 1]])
    return (np.bitwise_xor.reduce(swapped, axis=2) % np.uint32(table)).astype(np.int64)


def no_wrap(corner, table):
    return (
        np.bitwise_xor.reduce(
            corner.astype(np.uint64) * PRIMES[: corner.shape[2]].astype(np.uint64), axis=2
        ).astype(np.int64)
        % table
    )


def added(corner, table):
    return wrapped(corner).astype(np.int64).sum(axis=2) % 2**32 % table


# --- Eq. (9): what is asked and shown -----------------------------------------------------------
def levels_of(given):
    """Columns of h by level."""
    L, F = len(given["grids"]), given["grids"][0].shape[1]
    return np.arange(L * F).reshape(L, F)


def planes_exchanged(tree, given):
    names = [axes for axes, _ in given["resolutions"]]
    if names[-2:] != ["xz", "yz"]:
        raise NotApplicable("no planes xz and yz")
    order = levels_of(given)
    return {"h": tree["h"][:, order[[*range(len(names) - 2), -1, -2]].ravel()]}


def exchanged_axes(given):
    """Every level of xz reads at y and z, and every level of yz at x and z."""
    other = {"xz": "yz", "yz": "xz"}
    return {**given, "resolutions": [(other.get(a, a), res) for a, res in given["resolutions"]]}


def exchanged_places(given):
    """The same where a port assigns the planes by their place in a whole set."""
    if [axes for axes, _ in given["resolutions"]][-3:] != ["xy", "xz", "yz"]:
        raise NotApplicable("no whole set of planes")
    return exchanged_axes(given)


def feature_major(out, given):
    return {"h": out["h"][:, levels_of(given).T.ravel()]}


def feature_major_bar(bars, out, given):
    return {"h": bars["h"][:, np.argsort(levels_of(given).T.ravel())]}


def cube(given):
    return {**given, "hi": given["lo"] + (given["hi"] - given["lo"]).max()}


def everywhere(given, cotangents):
    """The gradient that passes all parameters: that of half their signs, which are all inside."""
    run = reading()
    out, _ = run(given, cotangents)
    return out, run({**given, "grids": [np.sign(grid) / 2 for grid in given["grids"]]}, cotangents)[
        1
    ]


def strictly(bars, given):
    return {"grids": [bar * (np.abs(grid) < 1) for bar, grid in zip(bars["grids"], given["grids"])]}


def zero_negative(given):
    return {
        **given,
        "grids": [np.where(grid == 0, -1, grid).astype(grid.dtype) for grid in given["grids"]],
    }


HASH_GRID = [
    known(
        "hash_grid",
        "hash-grid-planes",
        "the planes are concatenated as xyz, xy, yz, xz: the last two are exchanged",
        outputs=planes_exchanged,
        outputs_bar=lambda bars, out, given: planes_exchanged(bars, given),
    ),
    known(
        "hash_grid",
        "hash-grid-feature-major",
        "h runs feature by feature over the levels instead of level by level",
        outputs=feature_major,
        outputs_bar=feature_major_bar,
    ),
    known(
        "hash_grid",
        "hash-grid-cube",
        "the box is made a cube: all axes are divided by the longest extent",
        inputs=cube,
    ),
    surgery(
        "hash_grid",
        "hash-grid-res",
        "nodes stand at u res instead of u (res - 1)",
        reading(lambda u, res: np.minimum(u * res, res - 1)),
    ),
    surgery(
        "hash_grid",
        "hash-grid-cells",
        "nodes stand at the centres of res cells, u res - 1/2",
        reading(cells),
    ),
    surgery(
        "hash_grid",
        "hash-grid-nearest",
        "the nearest node is read instead of the multilinear mean",
        reading(lambda u, res: np.rint(u * (res - 1))),
    ),
    surgery(
        "hash_grid",
        "hash-grid-mirrored",
        "the weights of lower and upper corner are exchanged",
        reading(mirrored),
    ),
    surgery(
        "hash_grid",
        "hash-grid-dense-order",
        "dense levels are indexed with the last axis running fastest",
        reading(row=z_fastest),
    ),
    surgery(
        "hash_grid",
        "hash-grid-never-dense",
        "levels that would fit their table are hashed as well",
        reading(row=always_hashed),
    ),
    surgery(
        "hash_grid",
        "hash-grid-modulo-first",
        "the products are taken modulo the table size before the XOR",
        reading(row=dense_or(modulo_first)),
    ),
    surgery(
        "hash_grid",
        "hash-grid-prime-order",
        "the primes of y and z are exchanged",
        reading(row=dense_or(other_primes)),
    ),
    surgery(
        "hash_grid",
        "hash-grid-no-wrap",
        "the products are not wrapped to 32 bits",
        reading(row=dense_or(no_wrap)),
    ),
    surgery(
        "hash_grid",
        "hash-grid-added",
        "the products are added instead of combined by XOR",
        reading(row=dense_or(added)),
    ),
    surgery(
        "hash_grid",
        "hash-grid-sign-of-zero",
        "a parameter of zero reads as 0 instead of +1",
        reading(sign=np.sign),
    ),
    known(
        "hash_grid",
        "hash-grid-zero-negative",
        "a parameter of zero reads as -1 instead of +1",
        inputs=zero_negative,
    ),
    surgery(
        "hash_grid",
        "hash-grid-not-binary",
        "the parameters are read themselves, not their signs",
        reading(sign=lambda p: p),
    ),
    surgery(
        "hash_grid",
        "hash-grid-straight-through",
        "the straight-through gradient passes parameters beyond +-1 as well",
        everywhere,
    ),
    known(
        "hash_grid",
        "hash-grid-strictly-inside",
        "the straight-through gradient is 0 at a parameter of exactly +-1",
        inputs_bar=strictly,
    ),
    known(
        "hash_grid",
        "hash-grid-planes-by-place",
        "the grids of the planes are read in the order xy, yz, xz instead of xy, xz, yz",
        inputs=exchanged_places,
    ),
    known(
        "hash_grid",
        "hash-grid-planes-by-name",
        "the axes of the planes xz and yz are exchanged",
        inputs=exchanged_axes,
    ),
    surgery(
        "hash_grid",
        "hash-grid-cells-zeros",
        "nodes stand at the centres of res cells, u res - 1/2, with zeros around the grid",
        reading(lambda u, res: u * res - 0.5, zeros_outside=True),
    ),
    surgery(
        "hash_grid",
        "hash-grid-half-cell-up",
        "positions are half a cell too far, u (res - 1) + 1/2, as in instant-ngp",
        reading(half_cell_up),
    ),
    surgery(
        "hash_grid",
        "hash-grid-half-cell-inside",
        "positions begin and end half a cell inside the grid, u (res - 2) + 1/2, as in HAC",
        reading(half_cell_inside),
    ),
]


# --- Eq. (14) -----------------------------------------------------------------------------------
def entropy(own, other):
    """-own log2(own / (own + other)), 0 where there is none."""
    return -own * math.log2(own / (own + other)) if own else 0.0


def priced(bits, slope, positive=lambda grid: grid >= 0, inside=lambda grid: np.abs(grid) <= 1):
    """`run` with another price of the signs.

    bits(n_pos, n_neg) is the price and `slope` its slope in n_pos, where both signs occur. The
    rules `positive` and `inside` say what counts as positive and where the gradient passes.
    """

    def run(given, cotangents):
        grids = given["grids"]
        n_pos = sum(int(positive(grid).sum()) for grid in grids)
        n_neg = sum(grid.size for grid in grids) - n_pos
        bar = bars_of(cotangents)["R_hash"] * slope(n_pos, n_neg) / 2 if n_pos and n_neg else 0.0
        R = np.asarray(bits(n_pos, n_neg), grids[0].dtype if grids else float)
        return (
            {"R_hash": R, "n_pos": np.asarray(n_pos), "n_neg": np.asarray(n_neg)},
            {"grids": [(bar * inside(grid)).astype(grid.dtype) for grid in grids]},
        )

    return run


def shared(n_pos, n_neg):
    return entropy(n_pos, n_neg) + entropy(n_neg, n_pos)


def shared_slope(n_pos, n_neg):
    return math.log2(n_neg / n_pos)


def crossed(n_pos, n_neg):
    """N+ under p- and N- under p+."""
    n = n_pos + n_neg
    return n_pos * math.log2(n / n_neg) + n_neg * math.log2(n / n_pos) if n_pos and n_neg else 0.0


def crossed_slope(n_pos, n_neg):
    return math.log2(n_pos / n_neg) + (n_pos / n_neg - n_neg / n_pos) / math.log(2)


def clamped(n_pos, n_neg):
    p = min(max(n_pos / (n_pos + n_neg), 1e-6), 1 - 1e-6) if n_pos + n_neg else 0.5
    return -n_pos * math.log2(p) - n_neg * math.log2(1 - p)


def by_level(given, cotangents):
    """Every level under its own probability."""
    parts = [priced(shared, shared_slope)({"grids": [grid]}, cotangents) for grid in given["grids"]]
    total = {name: sum(out[name] for out, _ in parts) for name in ("R_hash", "n_pos", "n_neg")}
    return {name: np.asarray(a) for name, a in total.items()}, {
        "grids": [bars["grids"][0] for _, bars in parts]
    }


def scaled(factor):
    """Bits and gradient times factor(inputs)."""
    return dict(
        outputs=lambda out, given: {**out, "R_hash": np.asarray(out["R_hash"] * factor(given))},
        outputs_bar=lambda bars, out, given: {"R_hash": bars["R_hash"] * factor(given)},
    )


def per_entry(given):
    return 1 / np.float64(sum(grid.size for grid in given["grids"]))


HASH_RATE = [
    surgery(
        "hash_rate",
        "hash-rate-crossed",
        "p+ and p- are exchanged: N+ is priced by p- and N- by p+",
        priced(crossed, crossed_slope),
    ),
    known("hash_rate", "hash-rate-nats", "the bits are nats", **scaled(lambda given: math.log(2))),
    known(
        "hash_rate",
        "hash-rate-per-entry",
        "the bits are the mean over the entries instead of the sum",
        **scaled(per_entry),
    ),
    surgery(
        "hash_rate",
        "hash-rate-strict",
        "N+ counts what is greater than zero: zero is priced as negative",
        priced(shared, shared_slope, positive=lambda grid: grid > 0),
    ),
    surgery(
        "hash_rate",
        "hash-rate-clamp",
        "p+ is clamped to [1e-6, 1 - 1e-6], as HAC does",
        priced(clamped, shared_slope),
    ),
    surgery(
        "hash_rate",
        "hash-rate-by-level",
        "every level has its own p+ instead of one shared by all",
        by_level,
    ),
    surgery(
        "hash_rate",
        "hash-rate-straight-through",
        "the gradient passes parameters beyond +-1 as well",
        priced(shared, shared_slope, inside=lambda grid: np.ones(grid.shape, bool)),
    ),
    surgery(
        "hash_rate",
        "hash-rate-whole-sign",
        "the gradient counts a sign as 1 of N+ instead of 1/2: from -1 to +1 is 2",
        priced(shared, lambda n_pos, n_neg: 2 * shared_slope(n_pos, n_neg)),
    ),
]

MISTAKES = [*HASH_GRID, *HASH_RATE]
