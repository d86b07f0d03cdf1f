"""G2: the 3D Gaussian that a 4D Gaussian is at one time.

    Sigma   = R diag(s)**2 R^T = [[A, b], [b^T, var_t]]        A is 3 x 3, var_t a number
    x_t     = x + b (t - mu_t) / var_t
    Sigma_t = A - b b^T / var_t

Yang et al. 2023 (4DGS): the conditional distribution of (x, y, z) given t. b / var_t is the
velocity of the Gaussian. With M = R diag(s), whose last row is m, Sigma is M M^T. Subtracting
velocity times m from the other rows of M leaves their components Y perpendicular to m, and
Sigma_t = Y Y^T. This is the same matrix as the Schur complement above, which for a Gaussian that
lasts long and moves is a difference of nearly equal numbers.
"""

import numpy as np

from p4dgs_ref.equations.numerics import normalise, perpendicular


def forward(
    x,  # [N, 3]  means in space (scene units)
    mu_t,  # [N]  means in time
    s,  # [N, 4]  standard deviations along the four axes before they are turned
    R,  # [N, 4, 4]  rotations of (x, y, z, t)
    t,  # []  time of the picture
):
    """Return x_t [N, 3], Sigma_t [N, 3, 3], var_t [N] and what `backward` needs.

    var_t has a floor of 1e-24, so that a rotation of zeros gives a point at rest.
    """
    M = R * s[:, None, :]
    unit, duration = normalise(M[:, 3])
    velocity = np.einsum("naj,nj->na", M[:, :3], unit) / duration
    Y = perpendicular(unit[:, None, :], M[:, :3])
    x_t = x + velocity * (t - mu_t)[:, None]
    saved = (t - mu_t, s, R, unit, duration, velocity, Y)
    return (x_t, Y @ Y.transpose(0, 2, 1), duration[:, 0] ** 2), saved


def backward(saved, x_t_bar, Sigma_t_bar, var_t_bar):
    """Gradients of x, mu_t, s and R."""
    since, s, R, unit, duration, velocity, Y = saved
    # Of all multiples of m, velocity m is the one that leaves the shortest Y. Its slope is
    # therefore 0, and Sigma_t depends on M as if the velocity were a constant.
    Y_bar = (Sigma_t_bar + Sigma_t_bar.transpose(0, 2, 1)) @ Y
    # In the forward velocity = M[:, :3] unit / duration, so this product gets 1 / duration.
    dot_bar = x_t_bar * (since[:, None] / duration)
    M_bar = np.empty_like(R)
    M_bar[:, :3] = Y_bar + dot_bar[:, :, None] * unit[:, None, :]
    M_bar[:, 3] = (
        np.einsum("na,naj->nj", dot_bar / duration, Y)
        - np.einsum("na,naj->nj", velocity, M_bar[:, :3])
        + 2 * var_t_bar[:, None] * duration * unit
    )
    return {
        "x": x_t_bar,
        "mu_t": -(x_t_bar * velocity).sum(axis=1),
        "s": (M_bar * R).sum(axis=1),
        "R": M_bar * s[:, None, :],
    }
