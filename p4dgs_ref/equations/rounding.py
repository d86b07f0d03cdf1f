"""Eq. (10): hard quantisation, which replaces the noise of Eq. (7) when the file is written.

    f_hat = round(f / q) * q

P-4DGS, section 3.3 (adaptive quantisation). Ties round to even, and all rounded values are
multiples of q: the mean of Eq. (12) does not shift them (Q19).
"""

import numpy as np

LIMIT = 2.0**31  # of the magnitude of a symbol


def forward(
    f,  # [A, n]  attribute values (units of the attribute)
    q,  # [A, 1]  quantisation step, > 0
):
    """Return the symbols [A, n] int64, f_hat [A, n] and what `backward` needs.

    The symbols are what the entropy coder sees; a decoder multiplies them by q and never rounds.
    A symbol has no sign of zero: f = -0 gives f_hat = 0. Raises OverflowError if f / q is
    more than 2**31 in magnitude, or NaN.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # A quotient in float32 could itself be rounded onto a tie.
        ratio = np.rint(np.divide(f, q, dtype=np.float64))
    wrong = np.argwhere(~(np.abs(ratio) <= LIMIT))
    if len(wrong):
        a, i = wrong[0]
        raise OverflowError(f"f[{a}, {i}] = {f[a, i]} at step {q[a, 0]}: expected |f/q| up to 2^31")
    symbols = ratio.astype(np.int64)
    f_hat = (symbols * q.astype(np.float64)).astype(f.dtype)
    return (symbols, f_hat), ()


def backward(saved, f_hat_bar):
    """Return no gradients: rounding is flat almost everywhere; training uses Eq. (7) instead."""
    return {}
