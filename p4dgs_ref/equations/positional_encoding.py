"""The positional encoding in Eq. (5): sines and cosines that let a network see fine detail.

    E(p) = (p, sin 2^0 p, cos 2^0 p, ..., sin 2^(L-1) p, cos 2^(L-1) p)

P-4DGS, section 3.2 (temporal prediction), with the frequencies of D3DGS: p itself comes first and
there is no factor pi (Q2).
"""

import numpy as np


def forward(
    p,  # [N, D]  positions (scene units) or times (normalised), used as radians
    L,  # []  number of frequencies; 0 gives p alone
):
    """Return E [N, D (1 + 2 L)] and what `backward` needs.

    After p come, frequency by frequency, the sines of all coordinates, then their cosines.
    """
    N, D = p.shape
    # Scaling by a power of two is exact, so the argument of every sine is exactly 2^j p.
    angles = powers_of_two(L, p.dtype)[:, None, None] * p.T
    E = np.empty((D * (1 + 2 * L), N), dtype=p.dtype)  # transposed: sin and cos run along rows
    E[:D] = p.T
    waves = E[D:].reshape(L, 2, D, N)
    np.sin(angles, out=waves[:, 0])
    np.cos(angles, out=waves[:, 1])
    return E.T, (E.T, L)


def backward(saved, E_bar):
    """Return the gradient of p: the derivative of each sine is the cosine beside it."""
    E, L = saved
    N, width = E.shape
    D = width // (1 + 2 * L)
    waves = E.T[D:].reshape(L, 2, D, N)
    waves_bar = E_bar.T[D:].reshape(L, 2, D, N)
    angles_bar = waves[:, 1] * waves_bar[:, 0] - waves[:, 0] * waves_bar[:, 1]
    through_waves = np.tensordot(powers_of_two(L, angles_bar.dtype), angles_bar, axes=1)
    return {"p": E_bar[:, :D] + through_waves.T}


def powers_of_two(L, dtype):
    """Return 1, 2, 4, ..., 2^(L-1), exact; as an int64, 2^63 would be negative."""
    return np.ldexp(1.0, np.arange(L)).astype(dtype)
