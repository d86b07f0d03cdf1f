"""Vectors of level L0, the half of coding: grid cells and hashes, steps, deviations, ties, bins."""

import math

import numpy as np

from p4dgs_ref import EQUATIONS
from p4dgs_ref.equations.grid_nodes import nodes, table_rows
from tests.workshop.scalars import identity
from tests.workshop.subjects import as_published, no_pullback


# --- the hash grid ------------------------------------------------------------------------------
def cell_vjp(x, lo, hi, res):
    """The two nodes around a coordinate and their weights (Q11).

    Beyond the box its face counts. u = 0 where hi = lo. On the last node both nodes are that one.
    """
    first = np.array([1, 0, 0], x.dtype)
    node, weight = nodes(x[:, None] * first, lo * first, hi * first, "x", res, res)
    return {"node": node, "weight": weight}, no_pullback


def row_vjp(corner, res, table):
    """The row of a level's array that a corner (n, D) of a cell reads (Q11).

    It is i + j res + k res^2 if res^D <= table, else
    (i XOR 2654435761 j XOR 805459861 k) mod 2^32 mod table.
    """
    origin = np.zeros((1, corner.shape[1]), np.int64)
    return {"row": table_rows(corner, origin, res, table)[:, 0]}, no_pullback


# --- what follows psi_q and psi_p ---------------------------------------------------------------
def step_vjp(u, Q_0):
    """The step of a network's output u; its floor 2^-10 Q_0 is reached at u = -3.8121 (Q7)."""
    outputs, pullback = EQUATIONS["step"].vjp(h=u, **identity(u), Q_0=Q_0)
    return outputs, lambda **bars: {"u": pullback(**bars)["h"]}


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


# --- ties and bins ------------------------------------------------------------------------------


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


SUBJECTS = (
    as_published("grid_cell", cell_vjp),
    as_published("hash_index", row_vjp),
    as_published("step_floor", step_vjp),
    as_published("sigma_clamp", sigma_vjp),
    as_published("rounding_ties", EQUATIONS["rounding"].vjp),
    as_published("gaussian_bin", bin_vjp),
)
