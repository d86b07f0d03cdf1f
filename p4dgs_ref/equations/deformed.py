"""Eq. (6): the Gaussians at time t.

    x_t = x + delta_x        s_t = s + delta_s        r_t = (r + delta_r) / |r + delta_r|

P-4DGS, section 3.2 (temporal prediction). The paper prints r + delta_r; the sum is brought back to
unit length as in `rotation` (Q9), because `covariance` expects unit quaternions: from a sum of
another length it makes a matrix R that is not a rotation. A delta [N, 0] belongs to an effect that
the scene does not list: its attribute is returned as it is.
"""

from .numerics import normalise, normalise_backward


def forward(
    x,  # [N, 3]  canonical centres (scene units)
    s,  # [N, 3]  canonical standard deviations (scene units)
    r,  # [N, 4]  canonical unit quaternions
    delta_x,  # [N, 3]  movement; [N, 0] if the scene has no translation
    delta_s,  # [N, 3]  stretching; [N, 0] if it has no scaling
    delta_r,  # [N, 4]  turning; [N, 0] if it has no rotation
):
    """Return x_t [N, 3], s_t [N, 3], r_t [N, 4] and what `backward` needs.

    s_t may be zero or negative: the covariance depends on its square only.
    """
    x_t, s_t, r_t = add_delta(x, delta_x), add_delta(s, delta_s), add_delta(r, delta_r)
    norm = None
    if delta_r.shape[1]:
        r_t, norm = normalise(r_t)
    widths = delta_x.shape[1], delta_s.shape[1], delta_r.shape[1]
    return (x_t, s_t, r_t), (r_t, norm, widths)


def add_delta(attribute, delta):
    """Return attribute + delta, or the attribute itself if delta has no columns."""
    return attribute + delta if delta.shape[1] else attribute


def backward(saved, x_t_bar, s_t_bar, r_t_bar):
    """Return the gradients of x, s, r, delta_x, delta_s and delta_r."""
    r_t, norm, (width_x, width_s, width_r) = saved
    r_bar = r_t_bar if norm is None else normalise_backward(r_t, norm, r_t_bar)
    return {
        "x": x_t_bar,
        "s": s_t_bar,
        "r": r_bar,
        "delta_x": x_t_bar[:, :width_x],
        "delta_s": s_t_bar[:, :width_s],
        "delta_r": r_bar[:, :width_r],
    }
