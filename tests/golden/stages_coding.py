"""Vectors of level L2: Fig. 2, from positions to coding context, from noisy attributes to bits."""

from dataclasses import replace

import numpy as np

from p4dgs_ref import model
from p4dgs_ref.equations import prior, step
from p4dgs_ref.equations.grid_nodes import locate
from p4dgs_ref.lab.random_inputs import random_network
from p4dgs_ref.model import Context
from p4dgs_ref.splatting.table import EQUATIONS
from p4dgs_ref.training import objective
from tests.golden.cases import Case, hash_grid, hash_rate
from tests.golden.flat import EMPTY, flat_gradients, flat_networks, networks_of, shapes_of
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


def context_cases():
    def inputs(seed, A, d, k, resolutions, tables, F, hidden):
        rng = np.random.default_rng(seed)
        networks = {
            name: random_network(rng, F * len(tables), *hidden, columns)
            for name, columns in (("psi_q", 4), ("psi_p", 2 * (d + 6 + 3 * k)))
        }
        hi = np.array([1, 0.7, 0.4])
        return dict(
            x_a=rng.uniform(-1, 1, (A, 3)) * hi,
            lo=-hi,
            hi=hi,
            grids=[rng.uniform(-0.9, 0.9, (T, F)) for T in tables],
            resolutions=resolutions,
            Q_0=np.array([1.0, 0.001, 0.002, 0.2]),
            d=d,
            k=k,
            **flat_networks(networks),
        )

    dense = (("xyz", 3), ("xy", 4), ("xz", 4), ("yz", 4))
    hashed = (("xyz", 5), ("xyz", 9), ("xy", 7), ("yz", 11))
    outside = inputs(243, 8, 2, 4, (("xyz", 3), ("xz", 5)), (27, 25), 1, (5,))
    return [
        Case("ordinary", inputs(241, 7, 5, 2, dense, (27, 16, 16, 16), 2, (8,))),
        Case("hashed", inputs(242, 9, 4, 3, hashed, (32, 32, 19, 19), 3, (6, 7))),
        Case("outside_the_box", {**outside, "x_a": 1.7 * outside["x_a"]}, ("outside", "clamped")),
    ]


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


def rate_cases():
    def inputs(seed, A, d, k, spread, tables=((8, 2), (9, 2))):
        rng = np.random.default_rng(seed)
        n = d + 6 + 3 * k
        sigma, mu = rng.lognormal(-1, 0.5, (A, n)), rng.normal(size=(A, n))
        return dict(
            noisy=mu + spread * sigma * rng.normal(size=(A, n)),
            mu=mu,
            sigma=sigma,
            q=rng.uniform(0.1, 0.8, (A, 4)),
            mask=rng.random((A, k)) < 0.7,
            grids=[rng.uniform(-0.5, 0.9, shape) for shape in tables],
            d=d,
            k=k,
        )

    masked = inputs(253, 4, 5, 2, 1.0)
    return [
        Case("ordinary", inputs(251, 6, 4, 5, 1.0)),
        Case("tails", inputs(252, 5, 3, 2, 30.0), ("tail", "masked")),
        Case("all_masked", {**masked, "mask": np.zeros((4, 2), bool)}, ("masked",)),
    ]


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
        context_cases,
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
        rate_cases,
        surrogate=rate_surrogate,
    ),
)
