"""Eq. (15): what training minimises.

    L_total = lambda_rate * L_rate + L_render

P-4DGS, section 3.3 (training objective).
"""

from .numerics import in_precision_of


def forward(
    L_render,  # []  rendering loss of Eq. (16)
    L_rate,  # []  bits per coded value of Eq. (17), comparable between scenes (Q12)
    lambda_rate,  # []  weight of the rate; the paper gives no value, HAC uses 5e-4 to 4e-3
):
    """Return L_total [] and what `backward` needs."""
    weight = in_precision_of(L_rate, lambda_rate)
    return weight * L_rate + L_render, (lambda_rate,)


def backward(saved, L_total_bar):
    """Return the gradients of L_render and L_rate; lambda_rate is data."""
    (lambda_rate,) = saved
    weight = in_precision_of(L_total_bar, lambda_rate)
    return {"L_render": L_total_bar, "L_rate": weight * L_total_bar}
