"""Eq. (12): mean and standard deviation of every coded attribute, predicted from the hash feature.

    (mu, sigma) = psi_p(h)

P-4DGS, section 3.3 (context entropy coding). The network returns mu and log sigma, which is
clamped to -14 ... 6 (Q8).
"""

import numpy as np

from . import mlp

RAW_MIN, RAW_MAX = -14.0, 6.0  # of log sigma: 8e-7 to 403 attribute units


def forward(
    h,  # [A, I]  hash feature of each anchor
    weights,  # psi_p, I -> 2n
    biases,
    widths,  # [G]  coded values per anchor in each group f, s, l, O; n is their sum
):
    """Return mu [A, n], sigma [A, n] (units of the attribute) and what `backward` needs.

    The clamp of log sigma passes the gradient inside and on its ends and stops it outside.
    """
    psi_p, saved_mlp = mlp.forward(h, weights, biases)
    mu_columns, raw_columns = layout(widths)
    mu, raw = psi_p[:, mu_columns], psi_p[:, raw_columns]
    sigma = np.exp(np.clip(raw, RAW_MIN, RAW_MAX))
    free = (raw >= RAW_MIN) & (raw <= RAW_MAX)
    return (mu, sigma), (sigma, free, mu_columns, raw_columns, saved_mlp)


def backward(saved, mu_bar, sigma_bar):
    """Return the gradients of h, weights and biases."""
    sigma, free, mu_columns, raw_columns, saved_mlp = saved
    A, n = sigma.shape
    psi_p_bar = np.empty((A, 2 * n), sigma.dtype)
    psi_p_bar[:, mu_columns] = mu_bar
    psi_p_bar[:, raw_columns] = sigma_bar * sigma * free
    gradients = mlp.backward(saved_mlp, psi_p_bar)
    return {"h": gradients.pop("x"), **gradients}


def layout(widths):
    """Return the columns of mu and of log sigma: for each group all mu, then all log sigma."""
    ends = np.cumsum(widths)  # the mu of a group stand behind all mu and log sigma before it
    mu = np.arange(ends[-1]) + np.repeat(ends - widths, widths)
    return mu, mu + np.repeat(widths, widths)
