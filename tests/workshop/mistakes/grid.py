"""Known mistakes in Eqs. (9) and (14): reading the binary hash grid, and pricing it."""

import math

import numpy as np

from p4dgs_ref.equations.grid_nodes import PRIMES
from tests.workshop.mistakes.kit import NotApplicable, edited, known, port, surgery

# Text of the equations that several mistakes replace.
NODES = "p4dgs_ref.equations.grid_nodes"
POSITION = "np.clip(u, 0, 1) * (res - 1)"
SIGNS = "np.where(np.concatenate(grids) >= 0, 1, -1)"
PRODUCTS = "corner.astype(np.uint32) * PRIMES[:D]"


# --- Eq. (9) -----------------------------------------------------------------------------------
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


def lower_cell(out, given):
    """The last node as the upper end of the cell before it."""
    res = given["res"]
    last = (out["node"][:, :1] == res - 1) & (res > 1)
    return {
        "node": np.where(last, [res - 2, res - 1], out["node"]),
        "weight": np.where(last, [0.0, 1.0], out["weight"]),
    }


HASH_GRID = [
    known(
        "grid_cell",
        "grid-cell-last-node",
        "the last node is (res - 2, weight 1), which is as right; the convention is (res - 1, 0)",
        outputs=lower_cell,
    ),
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
    edited(
        "hash_grid",
        "hash-grid-res",
        "nodes stand at u res instead of u (res - 1)",
        {POSITION: "np.minimum(np.clip(u, 0, 1) * res, res - 1)"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-cells",
        "nodes stand at the centres of res cells, u res - 1/2",
        {POSITION: "np.clip(np.clip(u, 0, 1) * res - 0.5, 0, res - 1)"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-nearest",
        "the nearest node is read instead of the multilinear mean",
        {POSITION: "np.rint(np.clip(u, 0, 1) * (res - 1))"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-mirrored",
        "the weights of lower and upper corner are exchanged",
        {"np.where(step, fraction, 1 - fraction)": "np.where(step, 1 - fraction, fraction)"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-dense-order",
        "dense levels are indexed with the last axis running fastest",
        {"corner @ res ** np.arange(D)": "corner @ res ** np.arange(D)[::-1]"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-never-dense",
        "levels that fit their table are hashed as well",
        {"if res**D <= table:": "if False:"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-dense-strict",
        "levels that fill their table exactly are hashed as well (< for <=)",
        {"if res**D <= table:": "if res**D < table:"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-dense-if-full",
        "only levels whose nodes fill their table are stored densely, not those that leave rows",
        {"if res**D <= table:": "if res**D == table:"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-modulo-first",
        "the products are taken modulo the table size before the XOR",
        {"* PRIMES[:D]": "* PRIMES[:D] % np.uint32(table)"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-prime-order",
        "the primes of y and z are exchanged",
        {"* PRIMES[:D]": "* PRIMES[[0, 2, 1]][:D]"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-teschner",
        "another set of primes: 73856093, 19349663, 83492791 of Teschner et al. 2003",
        {"* PRIMES[:D]": "* np.array([73856093, 19349663, 83492791], np.uint32)[:D]"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-primes-from-second",
        "the axes are multiplied by 2654435761, 805459861, 3674653429: the first is not 1",
        {"* PRIMES[:D]": "* np.array([2654435761, 805459861, 3674653429], np.uint32)[:D]"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-smoothstep",
        "the weights are smoothed: f^2 (3 - 2 f) for the fraction f",
        {
            "(position - base)[:, None, :]": (
                "((position - base) ** 2 * (3 - 2 * (position - base)))[:, None, :]"
            )
        },
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-no-wrap",
        "the products are not wrapped to 32 bits",
        {
            PRODUCTS: "corner.astype(np.uint64) * PRIMES[:D].astype(np.uint64)",
            "hashed % np.uint32(table)": "hashed.astype(np.int64) % table",
        },
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-added",
        "the products are added instead of combined by XOR",
        {
            "np.bitwise_xor.reduce(corner.astype(np.uint32) * PRIMES[:D], axis=2)": (
                "np.add.reduce(corner.astype(np.uint32) * PRIMES[:D], axis=2, dtype=np.uint32)"
            )
        },
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-sign-of-zero",
        "a parameter of zero reads as 0 instead of +1",
        {SIGNS: "np.sign(np.concatenate(grids))"},
    ),
    edited(
        "hash_grid",
        "hash-grid-zero-negative",
        "a parameter of zero reads as -1 instead of +1",
        {SIGNS: "np.where(np.concatenate(grids) > 0, 1, -1)"},
    ),
    edited(
        "hash_grid",
        "hash-grid-not-binary",
        "the parameters are read themselves, not their signs",
        {SIGNS: "np.concatenate(grids)"},
    ),
    edited(
        "hash_grid",
        "hash-grid-straight-through",
        "the straight-through gradient passes parameters beyond +-1 as well",
        {"np.abs(grid) <= 1 for": "np.isfinite(grid) for"},
    ),
    edited(
        "hash_grid",
        "hash-grid-strictly-inside",
        "the straight-through gradient is 0 at a parameter of exactly +-1",
        {"np.abs(grid) <= 1 for": "np.abs(grid) < 1 for"},
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
    edited(
        "hash_grid",
        "hash-grid-cells-zeros",
        "nodes stand at the centres of res cells, u res - 1/2, with zeros around the grid",
        {
            POSITION: "np.clip(u, 0, 1) * res - 0.5",
            "np.where(step, fraction, 1 - fraction).prod(axis=2)": (
                "(np.where(step, fraction, 1 - fraction) * ((base[:, None] + step >= 0) & "
                "(base[:, None] + step < res))).prod(axis=2)"
            ),
            "np.minimum(base[:, None, :] + step, res - 1)": (
                "np.clip(base[:, None, :] + step, 0, res - 1)"
            ),
        },
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-half-cell-up",
        "positions are half a cell too far, u (res - 1) + 1/2, as in instant-ngp",
        {POSITION: "np.clip(u, 0, 1) * (res - 1) + 0.5"},
        helper=NODES,
    ),
    edited(
        "hash_grid",
        "hash-grid-half-cell-inside",
        "positions begin and end half a cell inside the grid, u (res - 2) + 1/2, as in HAC",
        {
            POSITION: "np.clip(u, 0, 1) * (res - 2) + 0.5",
            "np.minimum(base[:, None, :] + step, res - 1)": (
                "np.clip(base[:, None, :] + step, 0, res - 1)"
            ),
        },
        helper=NODES,
    ),
]


# --- Eq. (14) -----------------------------------------------------------------------------------


def by_level(given, cotangents):
    """Every level under its own probability."""
    parts = [port("hash_rate")({"grids": [grid]}, cotangents) for grid in given["grids"]]
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


def rounded_count(dtype, left):
    """Signs as h + p - stop_gradient(p), which are summed in a precision."""
    return edited(
        "hash_rate",
        f"hash-rate-rounded-count-{dtype}",
        f"signs are h + p - stop_gradient(p), which leaves {left} of a count of 0: count p >= 0",
        {
            "int(np.count_nonzero(grid >= 0)) for grid in grids": (
                "float(((np.where(p >= 0, p.dtype.type(1), -1) + p - p + 1) / 2).sum()) "
                f"for p in (grid.astype(np.{dtype}) for grid in grids)"
            ),
            "entropy(n_pos, n - n_pos)": (
                f"sum(-own * np.log2(np.{dtype}(own) / np.{dtype}(n)) "
                "for own in (n_pos, n - n_pos) if own)"
            ),
            "np.asarray(n_pos), np.asarray(n - n_pos)": (
                "np.asarray(round(n_pos)), np.asarray(n - round(n_pos))"
            ),
        },
    )


HASH_RATE = [
    rounded_count("float64", "1e-17"),
    rounded_count("float32", "1e-8"),
    edited(
        "hash_rate",
        "hash-rate-crossed",
        "p+ and p- are exchanged: N+ is priced by p- and N- by p+",
        {
            "n * math.log1p(other / n)": "n * math.log1p(n / other) if other else 0",
            "np.log2((n - n_pos) / n_pos)": (
                "(np.log2(n_pos / (n - n_pos)) + (n_pos / (n - n_pos) - (n - n_pos) / n_pos) "
                "/ math.log(2))"
            ),
        },
    ),
    known("hash_rate", "hash-rate-nats", "the bits are nats", **scaled(lambda given: math.log(2))),
    known(
        "hash_rate",
        "hash-rate-per-entry",
        "the bits are the mean over the entries instead of the sum",
        **scaled(per_entry),
    ),
    edited(
        "hash_rate",
        "hash-rate-strict",
        "N+ counts what is greater than zero: zero is priced as negative",
        {"np.count_nonzero(grid >= 0)": "np.count_nonzero(grid > 0)"},
    ),
    edited(
        "hash_rate",
        "hash-rate-clamp",
        "p+ is clamped to [1e-6, 1 - 1e-6], as HAC does",
        {
            "entropy(n_pos, n - n_pos)": (
                "-n_pos * np.log2(p := np.clip(n_pos / max(n, 1), 1e-6, 1 - 1e-6)) - (n - "
                "n_pos) * np.log2(1 - p)"
            )
        },
    ),
    surgery(
        "hash_rate",
        "hash-rate-by-level",
        "every level has its own p+ instead of one shared by all",
        by_level,
    ),
    edited(
        "hash_rate",
        "hash-rate-straight-through",
        "the gradient passes parameters beyond +-1 as well",
        {"np.where(np.abs(grid) <= 1, slope, 0)": "np.where(np.isfinite(grid), slope, 0)"},
    ),
    edited(
        "hash_rate",
        "hash-rate-whole-sign",
        "the gradient counts a sign as 1 of N+ instead of 1/2: from -1 to +1 is 2",
        {"0.5 * np.log2": "np.log2"},
    ),
]


# --- the row of a corner ------------------------------------------------------------------------
def products(corner):
    return corner.astype(np.uint32) * PRIMES[: corner.shape[1]]


def xor(corner):
    return np.bitwise_xor.reduce(products(corner), axis=1)


def first_fastest(corner, res):
    return corner @ res ** np.arange(corner.shape[1])


def of_row(name, description, hashed=xor, dense=first_fastest, is_dense=np.less_equal):
    """A mistake in one part of the rule for the row of a corner."""

    def run(given, _):
        corner, res, table = given["corner"], given["res"], given["table"]
        if is_dense(res ** corner.shape[1], table):
            row = dense(corner, res)
        else:
            row = hashed(corner) % hashed(corner).dtype.type(table)
        return {"row": row.astype(np.int64)}, {}

    return surgery("hash_index", f"hash-index-{name}", description, run)


HASH_INDEX = [
    of_row(
        "no-wrap",
        "the products are not wrapped to 32 bits before the XOR",
        lambda corner: np.bitwise_xor.reduce(
            corner * PRIMES[: corner.shape[1]].astype(np.int64), axis=1
        ),
    ),
    of_row(
        "added", "the products are added: XOR is meant", lambda c: products(c).sum(1, np.uint32)
    ),
    of_row(
        "always-hashed",
        "corners are hashed also where all nodes fit the table",
        is_dense=lambda nodes, table: False,
    ),
    of_row(
        "dense-strict", "< for <=: hashed where the nodes fill the table exactly", is_dense=np.less
    ),
    of_row(
        "last-fastest",
        "where the table holds all nodes, the last axis runs fastest",
        dense=lambda corner, res: first_fastest(corner[:, ::-1], res),
    ),
    of_row(
        "prime-order",
        "the primes of y and z are exchanged in the hash",
        lambda c: np.bitwise_xor.reduce(
            c.astype(np.uint32) * PRIMES[[0, 2, 1]][: c.shape[1]], axis=1
        ),
    ),
]

MISTAKES = [*HASH_GRID, *HASH_INDEX, *HASH_RATE]
