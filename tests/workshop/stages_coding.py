"""Vectors of level L2: Fig. 2, from positions to coding context, from noisy attributes to bits."""

from dataclasses import replace

from p4dgs_ref import EQUATIONS, model
from p4dgs_ref.equations.grid_nodes import locate
from p4dgs_ref.model import Context
from p4dgs_ref.training import objective
from tests.workshop.flat import EMPTY, flat_gradients, networks_of
from tests.workshop.subjects import as_published


# --- positions -> steps and priors --------------------------------------------------------------
def context_vjp(x_a, lo, hi, grids, resolutions, Q_0, d, k, **networks):
    """The coding context: hash grid, adaptive steps, prior (Eqs. 8, 9 and 12).

    The columns of mu and sigma are f, s, l, O. Gradients of the grids are straight-through.
    """
    outputs, grid_pullback = EQUATIONS["hash_grid"].vjp(
        x_a=x_a, lo=lo, hi=hi, grids=grids, resolutions=resolutions
    )
    located = locate(x_a, lo, hi, resolutions, [len(grid) for grid in grids])
    design = replace(EMPTY, d=d, k=k, Q_0=tuple(Q_0))
    context, back = model.context(design, networks_of(networks), grids, located)

    def pullback(h_bar, q_bar, mu_bar, sigma_bar):
        direct = grid_pullback(h_bar=h_bar)["grids"]
        through, bars = back(q_bar, mu_bar, sigma_bar)
        grids_bar = [a + b for a, b in zip(direct, through)]
        return {"grids": grids_bar, **flat_gradients(bars)}

    return {**outputs, **context._asdict()}, pullback


# --- noisy attributes -> bits -------------------------------------------------------------------
def rate_vjp(noisy, mu, sigma, q, mask, grids, d, k):
    """The rate of everything: likelihood, anchor rate, hash rate, rate loss (Eqs. 11, 13, 14, 17).

    The columns of noisy, mu and sigma are f, s, l, O; all columns of a group have one q (Q6).
    Masked offsets receive no gradient (Q15); gradients of the grids are straight-through.
    """
    design = replace(EMPTY, d=d, k=k)
    (bits, L_rate), back = objective.rate(noisy, Context(q, mu, sigma), grids, mask, design)

    def pullback(bits_bar, L_rate_bar):
        both = L_rate_bar + noisy.size * bits_bar  # bits = A n L_rate
        names = ("noisy", "mu", "sigma", "q", "grids")
        return dict(zip(names, back(both)))

    return {"bits": bits, "L_rate": L_rate}, pullback


SUBJECTS = (
    as_published("context_stage", context_vjp),
    as_published("rate_stage", rate_vjp),
)
