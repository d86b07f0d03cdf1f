"""G3: how visible a 4D Gaussian is at one time.

    weight = exp(-(t - mu_t)**2 / (2 var_t))        alpha_t = alpha weight

Yang et al. 2023 (4DGS). The weight is the marginal density of time without its normalisation, so
that it is 1 at mu_t.
"""

import numpy as np


def forward(
    alpha,  # [N]  opacities at mu_t
    mu_t,  # [N]  means in time
    var_t,  # [N]  variances of time, > 0
    t,  # []  time of the picture
):
    """Return alpha_t [N], weight [N] and what `backward` needs."""
    since = t - mu_t
    weight = np.exp(-0.5 * since * (since / var_t))
    return (alpha * weight, weight), (alpha, weight, since / var_t)


def backward(saved, alpha_t_bar, weight_bar):
    """Gradients of alpha, mu_t and var_t."""
    alpha, weight, u = saved  # u = (t - mu_t) / var_t
    # The weight first: where it is 0, the square of u may overflow.
    slope = (alpha_t_bar * alpha + weight_bar) * weight * u
    return {"alpha": alpha_t_bar * weight, "mu_t": slope, "var_t": 0.5 * slope * u}
