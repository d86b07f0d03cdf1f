"""Eq. (14): the bits of the binary hash grid, whose entries share one probability.

    R_hash = N_pos * (-log2 p_pos) + N_neg * (-log2 p_neg)        p_pos = N_pos / (N_pos + N_neg)

P-4DGS, section 3.3 (context entropy coding). If all signs agree the rate is 0; HAC clamps the
probabilities to [1e-6, 1 - 1e-6] instead.
"""

import math

import numpy as np


def forward(
    grids,  # list of [T, F], one per level: parameters; entries >= 0, also -0, count as +1 (Q11)
):
    """Return R_hash [] in bits, the counts n_pos and n_neg [], and what `backward` needs.

    Without levels or entries the rate is 0.
    """
    n = sum(grid.size for grid in grids)
    n_pos = sum(int(np.count_nonzero(grid >= 0)) for grid in grids)
    dtype = grids[0].dtype if grids else np.float64
    R_hash = np.asarray(entropy(n_pos, n - n_pos), dtype)
    return (R_hash, np.asarray(n_pos), np.asarray(n - n_pos)), (grids, n_pos, n)


def backward(saved, R_hash_bar):
    """Return the gradients of the grids, straight-through.

    The sign counts as the identity where |parameter| <= 1; elsewhere the gradient is 0. It is also
    0 if all signs agree, although the slope is infinite there.
    """
    grids, n_pos, n = saved
    slope = 0.0
    if 0 < n_pos < n:
        # dR / dN_pos = log2(N_neg / N_pos): the probabilities change with the counts, too, but they
        # minimise R for these counts, so their change adds nothing. A sign adds (1 + sign) / 2 to
        # N_pos, hence one half.
        slope = 0.5 * np.log2((n - n_pos) / n_pos) * float(R_hash_bar)
    return {"grids": [np.where(np.abs(grid) <= 1, slope, 0).astype(grid.dtype) for grid in grids]}


def entropy(n_pos, n_neg):
    """Return the bits of n_pos signs of one kind and n_neg of the other, which may be fractions.

    -log p is computed as log(1 + other / n): the logarithm of a p close to 1 loses digits.
    """
    bits = 0
    for n, other in ((n_pos, n_neg), (n_neg, n_pos)):
        if n:
            bits += n * math.log1p(other / n)
    return bits / math.log(2)
