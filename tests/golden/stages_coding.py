"""Vectors of level L2: Fig. 2, from positions to coding context, from noisy attributes to bits."""

from dataclasses import replace

from p4dgs_ref import model
from p4dgs_ref.equations import prior, step
from p4dgs_ref.equations.grid_nodes import locate
from p4dgs_ref.model import Context
from p4dgs_ref.table import EQUATIONS
from p4dgs_ref.training import objective
from tests.golden.cases import hash_grid, hash_rate
from tests.golden.flat import EMPTY, as_published, flat_gradients, networks_of, shapes_of
from tests.golden.subjects import Subject


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


def context_surrogate(**base):
    """The context of grids whose signs stay those of `base` and move by the parameters' change."""
    names = ("x_a", "lo", "hi", "grids", "resolutions")
    read = hash_grid.surrogate(**{name: base[name] for name in names})

    def smooth(grids, Q_0, d, k, **inputs):
        h = read(grids=grids)
        networks = networks_of(inputs)
        q, _ = step.forward(h, *networks["psi_q"], Q_0)
        (mu, sigma), _ = prior.forward(h, *networks["psi_p"], (d, 3, 3, 3 * k))
        return {"h": h, "q": q, "mu": mu, "sigma": sigma}

    return smooth


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


def rate_surrogate(**base):
    """The rate of grids whose signs stay those of `base` and move by the parameters' change."""
    priced = hash_rate.surrogate(base["grids"])
    held = EQUATIONS["hash_rate"](grids=base["grids"])["R_hash"]

    def smooth(grids, **others):
        outputs = rate_vjp(grids=base["grids"], **others)[0]
        more = priced(grids=grids)[0] - held
        count = others["noisy"].size
        return {"bits": outputs["bits"] + more, "L_rate": outputs["L_rate"] + more / count}

    return smooth


SUBJECTS = (
    Subject(
        "context_stage",
        "L2",
        "hash_grid",
        "8, 9, 12",
        "positions -> h, q, mu, sigma",
        {
            "x_a": "A 3",
            "lo": "3",
            "hi": "3",
            "grids": "*T F",
            "resolutions": "",
            "Q_0": "G",
            "d": "",
            "k": "",
            **shapes_of("psi_q", "psi_p"),
            "h": "A I",
            "q": "A G",
            "mu": "A n",
            "sigma": "A n",
        },
        ("grids", *shapes_of("psi_q", "psi_p")),
        context_vjp,
        as_published("context_stage"),
        surrogate=context_surrogate,
    ),
    Subject(
        "rate_stage",
        "L2",
        "rate_loss",
        "11, 13, 14, 17",
        "noisy attributes -> bits, L_rate",
        {
            "noisy": "A n",
            "mu": "A n",
            "sigma": "A n",
            "q": "A 4",
            "mask": "A k",
            "grids": "*T F",
            "d": "",
            "k": "",
            "bits": "",
            "L_rate": "",
        },
        ("noisy", "mu", "sigma", "q", "grids"),
        rate_vjp,
        as_published("rate_stage"),
        surrogate=rate_surrogate,
    ),
)
