"""Eq. (7): uniform noise stands in for rounding during training, because rounding has no gradient.

    f_noisy = f + u * q        u uniform in [-1/2, 1/2)

P-4DGS, section 3.3 (adaptive quantisation); the noise model is that of Balle et al. 2016.
"""


def forward(
    f,  # [A, n]  attribute values (units of the attribute)
    u,  # [A, n]  noise in [-1/2, 1/2), drawn by the caller; rendering and rate share it (Q23)
    q,  # [A, 1]  quantisation step, > 0; one for each anchor and attribute group (Q6)
):
    """Return f_noisy [A, n] and what `backward` needs."""
    return f + u * q, (u,)


def backward(saved, f_noisy_bar):
    """Return the gradients of f and q; the noise is data."""
    (u,) = saved
    return {
        "f": f_noisy_bar,
        "q": (f_noisy_bar * u).sum(axis=1, keepdims=True),  # one step for all n values
    }
