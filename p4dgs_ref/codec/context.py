"""The seam between the trained float context and the integers that the entropy coder works with.

Encoder and decoder both call `coding_context`; whatever it returns decides how every symbol is coded, so both
must get the same integers.  Here it is evaluated in float64 and snapped to coarse lattices, which makes the same
machine agree with itself.  Nothing else in the codec computes with real numbers.
"""
from typing import NamedTuple

import numpy as np

from ..equations import hash_grid
from ..model import context
from .gaussian_table import MU_BITS, MU_LIMIT, SIGMA_BITS, SIGMA_MAX, SIGMA_MIN

STEP_UNITS = 2**16         # q = units * 2 Q_0 / 2^16; the floor of Q7, 2^-10 Q_0, is 32 units
STEP_FLOOR = 32


class CodingContext(NamedTuple):
    q: np.ndarray              # (A, 4) float64, the steps of f, s, l, O: the same double everywhere
    mu_units: np.ndarray       # (A, n) int64, mu / q in units of 2^-MU_BITS; columns as `model.join`
    sigma_units: np.ndarray    # (A, n) int64, log2(sigma / q) in units of 2^-SIGMA_BITS
    mu: np.ndarray             # (A, n) what the float model says, for estimates only
    sigma: np.ndarray          # (A, n)


def coding_context(design, networks, grids, x_a, box):
    """Steps, means and deviations of every coded attribute as the coder uses them.

    Shapes     x_a (A, 3) positions on the lattice of `box`; grids: levels (T, F) of +-1
    Choice     Q6 one step per group; Q7 its floor; Q11 the grid; the lattices of q, mu and sigma are the codec's
    Reference  P-4DGS Eqs. (8), (9), (12)
    """
    located = hash_grid.locate(x_a, *(corner.astype(float) for corner in box), design.grid,
                               [T for T, _ in design.levels()])
    ctx, _ = context(design, networks, grids, located)
    units = 2 * np.array(design.Q_0) / STEP_UNITS
    q = np.clip(np.rint(ctx.q / units), STEP_FLOOR, STEP_UNITS) * units
    wide = np.repeat(q, design.widths, axis=1)
    mu_units = np.rint(np.clip(ctx.mu / wide * 2.0**MU_BITS, -MU_LIMIT, MU_LIMIT)).astype(np.int64)
    log_sigma = np.log2(ctx.sigma / wide) * 2.0**SIGMA_BITS
    sigma_units = np.rint(np.clip(log_sigma, SIGMA_MIN, SIGMA_MAX)).astype(np.int64)
    return CodingContext(q, mu_units, sigma_units, ctx.mu, ctx.sigma)
